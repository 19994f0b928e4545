# Kernels are written in a language of their own: everything in warp is Any here.
from typing import Any

def __getattr__(name: str) -> Any: ...
