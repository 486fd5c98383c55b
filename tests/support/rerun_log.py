import numpy as np
import rerun as rr


class Told:
    """A Rerun recording read back: its chunks by entity."""

    def __init__(self, path):
        self.reader = rr.chunk.RrdReader(path)
        self.chunks = {}
        for chunk in self.reader.stream():
            self.chunks.setdefault(chunk.entity_path, []).append(chunk)

    def values(self, entity, component):
        """All values of a component, in order of their stamps."""
        rows = []
        for chunk in self.chunks[entity]:
            batch = chunk.to_record_batch()
            if component in batch.schema.names:
                values = batch.column(component).to_pylist()
                stamps = (
                    batch.column("stamp").cast("int64").to_pylist()
                    if "stamp" in chunk.timeline_names
                    else [0]
                )
                rows += [
                    (stamp, value) for stamp, value in zip(stamps, values, strict=True) if value is not None
                ]
        return sorted(rows, key=lambda row: row[0])

    def one(self, entity, component):
        [(_, value)] = self.values(entity, component)
        return np.array(value)
