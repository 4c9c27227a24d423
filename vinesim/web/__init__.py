"""The page on which people and spectators see the vineyard: its server, and its messages."""
