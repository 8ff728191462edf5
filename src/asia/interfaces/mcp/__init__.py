"""A search as a server of the Model Context Protocol.

The server is a thin adapter over a desk: a submission is a file in the run directory, the search
that empties the queue is a process of its own, and nothing else is state. It may die at any time.
Importing this package is cheap: the MCP SDK, an extra, is loaded when a server is made.
"""
