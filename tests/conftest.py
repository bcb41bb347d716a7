"""Settings of the whole suite; nothing here imports bpy, so that tests of the core stay free of it."""

import platform
from importlib.metadata import PackageNotFoundError, version

from hypothesis import settings

settings.register_profile("ltsh", derandomize=True, deadline=None, database=None)
settings.load_profile("ltsh")


def pytest_report_header():
    """The line that tells two runs of `make test` apart."""
    names = []
    for name in ("bpy", "numpy", "OpenEXR", "scipy"):
        try:
            names.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            names.append(f"no {name}")
    return f"LTSH: Python {platform.python_version()}, {', '.join(names)}"
