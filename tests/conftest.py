"""Fixtures of all tests."""

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory) -> Iterator[None]:
    """Bakes are kept in a folder of this session: each happens once, and nothing enters or leaves the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARP_PSF_CACHE", str(tmp_path_factory.mktemp("fields")))
        yield
