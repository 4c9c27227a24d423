"""CMA-ES: what the package computes at import would take a type checker seven seconds."""

from typing import Any

def __getattr__(name: str) -> Any: ...
