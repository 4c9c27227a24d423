"""vinesim: soft vines and grapes, where robots and people meet."""

__version__ = "0.1.0"
