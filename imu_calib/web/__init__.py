"""A page that shows a running stand: the state from the nodes' messages, and its drawing.

`board` converts messages to a state, independent of browsers; `page` draws it with NiceGUI; `guard`
determines who may view the page and who may move the table; `server` serves it in a separate
thread.
"""
