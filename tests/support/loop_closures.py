"""Loop closures made by hand."""

import numpy as np

from mapper.graph.model import PoseSigmas
from mapper.loops.closure import LoopClosure

SURE = PoseSigmas(rotation_rad=0.01, translation_m=0.01).information


def loop(i: int, j: int, T_i_j: np.ndarray | None = None, **rest) -> LoopClosure:
    """Return an accepted loop of two nodes, with other fields as given."""
    T_i_j = np.eye(4) if T_i_j is None else T_i_j
    given = {"verdict": "accepted", "information": SURE, "T_i_j": T_i_j, **rest}
    return LoopClosure(i=i, j=j, stamp_i_ns=i, stamp_j_ns=j, proposed_by="places", **given)
