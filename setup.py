"""Lists the packages: `motionloom` is this folder, and `motionloom.<folder>` each in it with Python files.

A new folder, such as a model's, is so a package without being named anywhere.
"""

from __future__ import annotations

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOTS = ("configs", "datasets", "models", "pipeline")


def packages() -> list[str]:
    """Dotted names of all folders that hold Python files."""
    here = Path(__file__).resolve().parent
    folders = {path.parent.relative_to(here) for root in ROOTS for path in (here / root).rglob("*.py")}
    return ["motionloom", *sorted(".".join(("motionloom", *folder.parts)) for folder in folders)]


class BuildPackages(build_py):
    """Takes this file, which lies beside `__init__.py`, for no module."""

    def find_package_modules(self, package: str, folder: str) -> list[tuple[str, str, str]]:
        return [module for module in super().find_package_modules(package, folder) if module[1] != "setup"]


setup(packages=packages(), cmdclass={"build_py": BuildPackages})
