"""Extension of griffe, which reads the docstrings for the site: without the roles of Sphinx."""

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:func|class|attr|meth|mod|data|exc):`~?(?:[a-z]\w*\.)*([^`]*)`")


class WithoutRoles(griffe.Extension):
    """Turns ``:class:`~mapper.run.folder.Run` `` into ``Run``."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of a name."""
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub(r"`\1`", obj.docstring.value)
