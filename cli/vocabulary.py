"""``mapper vocabulary``: visual words trained on logs, and the content of such a file."""

from pathlib import Path
from typing import Annotated

import typer

from mapper.cli.answer import Answer, Output, verb
from mapper.cli.groups import Verb, VerbGroup
from mapper.cli.options import Overwrite, settings_of
from mapper.runtime.atomic import refuse_existing
from mapper.runtime.result_paths import name_of, place_of

_SEED = 0  # of the draws of k-means++: the same logs give the same bytes

vocabulary = typer.Typer(
    help="Train and inspect the visual words by which places are recognised.",
    epilog="Example: mapper vocabulary train LOG --out office.words",
    cls=VerbGroup,
    rich_markup_mode=None,
)


def train(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="Logs that mapper build can read.")],
    out: Annotated[Path | None, typer.Option(help="Vocabulary file to create.  [default: LOG.words]")] = None,
    frames: Annotated[int | None, typer.Option(help="Number of frames used of each log.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY.PATH=VALUE", help="branching, levels, detector.max_features, …"),
    ] = None,
    overwrite: Overwrite = False,
    *,
    output: Output,
) -> Answer:
    """Cluster the ORB descriptors of logs into a vocabulary.

    Example: mapper vocabulary train logs/office logs/lab --out lab.words --set branching=8
    """
    import numpy as np

    from mapper.config.loading import overridden
    from mapper.places.config import VocabularyConfig
    from mapper.places.training import descriptors_of
    from mapper.places.training import train as train_words
    from mapper.sources import open_source

    config = overridden(VocabularyConfig(), settings=settings_of({"frames_per_log": frames}, set_))
    out = place_of(out, Path(f"{name_of(logs[0])}.words"), overwrite=overwrite)
    refuse_existing(out, overwrite=overwrite)
    progress = output.progress()
    sources = [open_source(log) for log in logs]
    images = [bits for source in sources for bits in descriptors_of(source, config, progress=progress)]
    trained = train_words(
        images,
        config=config,
        trained_on=f"{len(images)} images of {', '.join(source.name for source in sources)}",
        rng=np.random.default_rng(_SEED),
        progress=progress,
    )
    trained.save(out)
    return _summary(out)


def show(
    path: Annotated[
        Path | None,
        typer.Argument(metavar="[VOCABULARY]", help="File to show; omit for the one that comes with mapper."),
    ] = None,
    *,
    output: Output,  # noqa: ARG001
) -> Answer:
    """Print the content of a vocabulary.

    Example: mapper vocabulary show lab.words
    """
    from mapper.places.vocabulary import SHIPPED

    return _summary(path or SHIPPED)


def _summary(path: Path) -> Answer:
    from mapper.places.vocabulary import load_vocabulary

    loaded = load_vocabulary(path)
    branching = int(loaded.tree.children.max())
    document = {
        "path": path,
        "words": loaded.words,
        "branching": branching,
        "levels": loaded.levels,
        "size_bytes": path.stat().st_size,
        "trained_on": loaded.trained_on,
        "least_weight": loaded.idf.min(),
        "greatest_weight": loaded.idf.max(),
    }
    text = (
        f"{path}: {loaded.words} words, {branching} × {loaded.levels} levels, "
        f"{path.stat().st_size / 1e3:.0f} kB\n"
        f"trained on {loaded.trained_on}\n"
        f"weights ln(N / N_w): {loaded.idf.min():.2f} … {loaded.idf.max():.2f}"
    )
    return Answer(document, text)


vocabulary.command("train", cls=Verb, short_help="Train visual words on logs")(verb(train))
vocabulary.command("show", cls=Verb, short_help="Print what a vocabulary holds")(verb(show))
