"""Finds things by name: in the modules of one package, and in installed packages of others.

A module of the package states what it has in a dictionary at module level, such as
`ALIGNERS = {"icp": make_icp}`, or `{"icp": "package.module:make_icp"}` where that module is slow to
import; another package states an entry point, such as

    [project.entry-points."iga_drake.aligners"]
    mine = "my_package.aligner:MyAligner"
"""

import importlib
import pkgutil
from collections.abc import Callable, Collection
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from iga_drake.errors import IgaDrakeError

T = TypeVar("T")


class Registry(Generic[T]):
    """Factories by name; listing the names imports the package's own modules and no others.

    Args:
      kind: what the factories make, for messages: "aligner".
      package: full name of the package whose modules (or subpackages) are searched.
      attribute: name of the modules' dictionary from name to factory, or to where one is.
      group: the entry points' group; an entry point's object is a factory.
      error: raised for names that are unknown, stated twice, or whose entry point doesn't load.
      reserved: names that can't be given to anything.
    """

    def __init__(
        self,
        kind: str,
        *,
        package: str,
        attribute: str,
        group: str,
        error: type[IgaDrakeError],
        reserved: Collection[str] = (),
    ):
        self.kind, self.package, self.attribute = kind, package, attribute
        self.group, self.error, self.reserved = group, error, reserved

    def names(self) -> list[str]:
        """All names, sorted. Raises `error` where two of them are the same."""
        return sorted(self._found())

    def check(self, name: str) -> None:
        """Raises `error`, which lists the known names, where `name` isn't among them."""
        names = self.names()
        if name not in names:
            raise self.error(f"unknown {self.kind} '{name}': one of: {', '.join(names)}")

    def factory(self, name: str) -> Callable[..., T]:
        """The factory called `name`. Raises `error` if it is unknown or does not load."""
        self.check(name)
        found = self._found()[name]
        if isinstance(found, str):
            return pkgutil.resolve_name(found)
        if not isinstance(found, EntryPoint):
            return found
        try:
            loaded = found.load()
        except Exception as error:
            raise self.error(
                f"{self.kind} '{name}': {_described(found)} does not load "
                f"({type(error).__name__}: {error}): repair or uninstall it"
            ) from error
        if not callable(loaded):
            raise self.error(
                f"{self.kind} '{name}': {_described(found)} is a {type(loaded).__name__}, "
                f"expected a callable that returns the {self.kind}"
            )
        return loaded

    def _found(self) -> dict[str, Any]:
        """Name -> factory, where one is, or the entry point that loads one."""
        found: dict[str, Any] = {}
        places = dict.fromkeys(self.reserved, "this package, which keeps it for a use of its own")

        def add(name: str, value: Any, place: str) -> None:
            if name in places:
                raise self.error(
                    f"{self.kind} '{name}' is stated twice: by {places[name]} and by {place}: "
                    "rename or remove one"
                )
            found[name], places[name] = value, place

        package = importlib.import_module(self.package)
        for info in pkgutil.iter_modules(package.__path__, f"{self.package}."):
            module = importlib.import_module(info.name)
            for name, value in getattr(module, self.attribute, {}).items():
                add(name, value, info.name)
        # An installed package may be found twice on sys.path; that is no contradiction.
        for point in dict.fromkeys(entry_points(group=self.group)):
            add(point.name, point, _described(point))
        return found


def _described(point: EntryPoint) -> str:
    """The entry point and the distribution that states it."""
    distribution = point.dist.name if point.dist else "unknown"
    return f"the entry point '{point.name} = {point.value}' of distribution '{distribution}'"
