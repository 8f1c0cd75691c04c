"""A page that shows a running stand: what its nodes say, as a state, and a page that draws it.

`board` makes the state of messages and knows no browser; `page` draws it with NiceGUI; `guard`
says who may look and who may move the table; `server` serves it in a thread of its own.
"""
