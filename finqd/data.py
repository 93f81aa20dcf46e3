"""Where the files that come with finqd are: the objects, the designs, and what studies of its accuracy have measured.

In a checkout they are the folders ``objects``, ``designs`` and ``studies`` at its top; a wheel carries them inside the
package (``finqd/bundled``), since a wheel has no top level of its own.
"""

from __future__ import annotations

from pathlib import Path

from finqd.errors import FinqdError

PACKAGE = Path(__file__).resolve().parent


def objects_folder() -> Path:
    """Return the folder with one JSON file for each object that comes with finqd."""
    return _folder("objects")


def designs_folder() -> Path:
    """Return the folder with the design files that come with finqd."""
    return _folder("designs")


def studies_folder() -> Path:
    """Return the folder with what has been measured of finqd's own accuracy."""
    return _folder("studies")


def bundled_names(folder: Path) -> list[str]:
    """Return the names (without ``.json``) of the files in one of those folders, sorted."""
    return sorted(path.stem for path in folder.glob("*.json"))


def _folder(name: str) -> Path:
    bundled = PACKAGE / "bundled" / name
    if bundled.is_dir():
        return bundled
    checkout = PACKAGE.parent
    if (checkout / "pyproject.toml").is_file() and (checkout / name).is_dir():
        return checkout / name
    raise FinqdError(f"this installation of finqd lacks its folder {name!r}; install it again")
