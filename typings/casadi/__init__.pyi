# casadi's own stubs refuse correct programs (MX against float): everything in it is Any here.
from typing import Any

def __getattr__(name: str) -> Any: ...
