"""A page that shows a running stand: its state from the nodes' messages, and its drawing."""
