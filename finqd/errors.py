"""What finqd raises, all under one root.

    FinqdError                everything below; the command line prints it as one sentence and exits with 2
    +-- InputError            something a user wrote is wrong: a design, an object, an option
    |   +-- PluginError       a plugin is unknown, registered twice, does not import or refuses its options
    +-- MissingLibraryError   a library of this machine is missing; the sentence names what to install
    +-- MeshError             a solid could not be meshed (in time)
    +-- WorkersError          the workers that evaluations run on are gone, or are not fit for them

A simulation that fails is none of these: it is data, a status and a reason in the result. A ``MeshError`` becomes such
a result too as soon as `finqd.evaluate` sees it.

>>> str(InputError("must lie in 90 to 120, got 5", where="fingers[0].length_mm"))
'fingers[0].length_mm: must lie in 90 to 120, got 5'
"""

from __future__ import annotations


class FinqdError(Exception):
    """Root of everything that finqd raises on purpose; ``str()`` is one sentence."""


class InputError(FinqdError):
    """Something that a user wrote is wrong.

    ``message``: one sentence, with the allowed values; ``where``: the place, a JSON path or file name, printed first.
    """

    def __init__(self, message: str, where: str = "") -> None:
        super().__init__(message, where)
        self.message = message
        self.where = where

    def __str__(self) -> str:
        return f"{self.where}: {self.message}" if self.where else self.message


class PluginError(InputError):
    """A plugin is unknown, registered twice, does not import, or refuses its options."""


class MissingLibraryError(FinqdError):
    """A library is missing on this machine; the sentence names the packages to install."""


class MeshError(FinqdError):
    """Meshing failed or ran out of time: the design's failure, recorded as data."""


class WorkersError(FinqdError):
    """The workers that evaluations run on cannot be reached, are gone, or run another finqd than this one."""
