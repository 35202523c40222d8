"""How the reference reads the source: what the imports of a package say, and no type where there is none."""

from typing import Any

import griffe


class Names(griffe.Extension):
    """A griffe extension, named in mkdocs.yml."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """A function exported under the name of its own module is meant where that name is exported."""
        if "_api" not in pkg.members:
            return
        for name in map(str, pkg["_api"].exports or ()):
            target = pkg["_api"][name]
            while target.is_module and target.name in target.members:
                target = target[target.name]
                pkg.set_member(name, griffe.Alias(name, target=target, parent=pkg))

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """`Any` stands for "array-like" in signatures: the description gives the shape."""
        for parameter in func.parameters:
            if str(parameter.annotation) == "Any":
                parameter.annotation = None
