# Its own annotations describe neither what its extension module holds nor arrays of its own types; names are not
# checked.
from typing import Any

def __getattr__(name: str) -> Any: ...
