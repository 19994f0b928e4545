# mujoco ships no type information that pyright can use: everything in it is Any here.
from typing import Any

def __getattr__(name: str) -> Any: ...
