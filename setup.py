"""Puts the lookup tables of tables/ into the Python package; pyproject.toml says the rest."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent


class BuildWithTables(build_py):
    """Copies tables/*.npz to ltsh_addon/tables, where an installed package finds them (lobes/lookup_table.py)."""

    def run(self):
        super().run()
        folder = Path(self.build_lib) / "ltsh_addon" / "tables"
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted((ROOT / "tables").glob("*.npz")):
            shutil.copy(path, folder)


setup(cmdclass={"build_py": BuildWithTables})
