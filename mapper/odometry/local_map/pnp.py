"""Placing a frame by its pixels alone, against the latest keyframes (Zhao et al. 2020, §1.2)."""

from collections.abc import Iterator

from mapper.config.odometry import PnpConfig
from mapper.geometry import inverse
from mapper.odometry.local_map.landmarks import LandmarkMap
from mapper.odometry.local_map.local_search import LocalSearch
from mapper.odometry.local_map.observation import Observation
from mapper.odometry.local_map.placing import Placement
from mapper.odometry.local_map.recall import Recall


class PnpPlacing:
    """Predicts nothing: each frame is matched by visual words and found by P3P."""

    def __init__(
        self, _config: PnpConfig, landmark_map: LandmarkMap, _search: LocalSearch, recall: Recall, /
    ) -> None:
        self._map = landmark_map
        self._recall = recall

    def place(
        self, observation: Observation, last: Placement, _before_last: Placement | None, /
    ) -> Placement | None:
        """Try the latest keyframes, and those that look like the frame while the answer is weak."""
        return self._recall.among(self._candidates(observation, last), observation, method="pnp")

    def _candidates(self, observation: Observation, last: Placement) -> Iterator[int]:
        latest = self._map.latest(last.reference)
        yield from latest
        here_world = inverse(last.T_camera_world)[:3, 3]
        yield from (k for k in self._recall.lookalikes(observation, here_world) if k not in latest)
