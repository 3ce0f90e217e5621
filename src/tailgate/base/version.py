"""The version and the folder of the package."""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

try:
    VERSION = version("tailgate")
except PackageNotFoundError:  # a source tree that was never installed
    VERSION = "0+unknown"

FOLDER = Path(__file__).parents[1]
