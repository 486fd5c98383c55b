"""Loops as the thesis corrects by them and as constraints of the graph: ATE RMSE of one log in one table.

    python benchmarks/loop_corrections.py [../shared/data/tum_fr1_xyz] [--config configs/thesis/ISVD+LC.toml]

Without --config: the thesis's ISVD+LC and ISVD+LC+DIF (Table 5.5), and the default.
"""

import argparse
from pathlib import Path

import cv2

from evaluators.corrections import corrections
from mapper.config import load_config
from mapper.sources import open_source

ROOT = Path(__file__).parents[1]
CONFIGS = (ROOT / "configs/thesis/ISVD+LC.toml", ROOT / "configs/thesis/ISVD+LC+DIF.toml", None)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("log", type=Path, nargs="?", default=ROOT.parent / "shared/data/tum_fr1_xyz")
    parser.add_argument("--config", type=Path, action="append")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'configuration':<16} {'correction':<14} {'ATE m':>7} {'loops':>6} {'lost':>5}")
    for path in arguments.config or CONFIGS:
        config = load_config(path)
        for row in corrections(open_source(arguments.log, config.source), config):
            name = "default" if path is None else path.stem
            print(f"{name:<16} {row.solve:<14} {row.ate_m:7.4f} {row.loops:6d} {row.lost:5d}", flush=True)


if __name__ == "__main__":
    main()
