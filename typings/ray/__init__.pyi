# ray is an extra that need not be installed where types are checked: everything in it is Any here.
from typing import Any

def __getattr__(name: str) -> Any: ...
