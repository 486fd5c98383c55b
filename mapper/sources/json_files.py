"""JSON files of scans, checked against a model of what is read of them."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from mapper.core.errors import SourceError
from mapper.runtime.regular_files import read_text

Model = TypeVar("Model", bound=BaseModel)


def read_json(path: Path, model: type[Model]) -> Model:
    """Return a file's values.

    Raises:
        SourceError: The file cannot be read, is no JSON, or lacks a value of the model.
    """
    return parse_json(read_text(path, error=SourceError), model, where=f"{path}")


def parse_json(text: str, model: type[Model], *, where: str) -> Model:
    """Return the values of a text; ``where`` names it in messages.

    Raises:
        SourceError: As :func:`read_json`.
    """
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise SourceError(f"{where}: {place + ': ' if place else ''}{first['msg']}") from None
