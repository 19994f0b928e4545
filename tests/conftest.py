"""Settings shared by all tests: one thread a worker, quiet logs, bounded hypothesis."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator

# Before numpy, torch and mujoco are imported: pytest-xdist runs several workers on few cores.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "ci",
    deadline=None,  # never judge by the clock
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    derandomize=True,
)
settings.load_profile("ci")


@pytest.fixture(autouse=True, scope="session")
def _one_torch_thread() -> None:
    import torch

    torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def _temporary_files_go_at_the_end(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[None]:
    """Of other libraries and of the programs that tests start. Not in pytest's own folder: the
    names of sockets in it would be too long."""
    tmp_path_factory.getbasetemp()  # which stays where it is, for who looks into it afterwards
    with (
        tempfile.TemporaryDirectory(prefix="t", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("TMPDIR", folder)
        patch.setattr(tempfile, "tempdir", folder)
        yield
