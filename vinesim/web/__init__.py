"""Server and messages of the page: the web page of a client on which people and spectators see the vineyard.

In this package, "a page" is one browser tab that is connected to the server.
"""
