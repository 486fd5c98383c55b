"""Log folders that appear whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mapper.errors import SourceError


@contextmanager
def appearing(out: Path) -> Iterator[Path]:
    """Yield a folder to fill; it takes ``out``'s place when it is complete, and is gone if it never is.

    Raises:
        SourceError: ``out`` is there and not empty, or cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SourceError(f"{out}: exists already; give a folder that does not, or remove it")
    out = out.resolve()
    partial = out.with_name(f"{out.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.rename(out)
    except OSError as error:
        raise SourceError(
            f"{out}: cannot be written: {error.strerror}; is there space and permission?"
        ) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
