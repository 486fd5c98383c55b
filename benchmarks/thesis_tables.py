"""Tables 5.1 and 5.2 of Somlyai's thesis for one log, ours beside the printed figures.

    python benchmarks/thesis_tables.py [../shared/data/tum_fr1_xyz] [--log-name fr1/xyz]

ATE RMSE in metres after SE(3) alignment. "auto" and the MP cells are configs/thesis/MPn.toml.
"""

import argparse
from pathlib import Path

import cv2

from evaluators.published import isvd_tables
from mapper.config import load_config
from mapper.config.odometry import IsvdOdometryConfig
from mapper.errors import ConfigError
from mapper.sources import open_source

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("log", type=Path, nargs="?", default=ROOT.parent / "shared/data/tum_fr1_xyz")
    parser.add_argument("--log-name", default="fr1/xyz", help="the log's name in the thesis")
    parser.add_argument("--config", type=Path, default=ROOT / "configs/thesis/ISVD.toml")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    config = load_config(arguments.config)
    if not isinstance(config.odometry, IsvdOdometryConfig):
        raise ConfigError(f"{arguments.config}: odometry.kind is {config.odometry.kind}, want isvd")
    table = ""
    for cell in isvd_tables(
        open_source(arguments.log, config.source), log_name=arguments.log_name, config=config.odometry
    ):
        if cell.table != table:
            table = cell.table
            print(f"\n{table}, {arguments.log_name}\n{'setting':<14} {'thesis':>8} {'ours':>8}  lost")
        print(f"{cell.setting:<14} {cell.published_m:8.4f} {cell.ours_m:8.4f}  {cell.lost:4d}", flush=True)


if __name__ == "__main__":
    main()
