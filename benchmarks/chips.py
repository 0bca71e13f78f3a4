"""Coverage of rotation, lever arm and time offset between the chips of simulated boards, moved by hand or on a table.

python benchmarks/chips.py --boards 200
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from board_simulator import by_hand, draw_chip, hand_board, table_board

from pipeline.estimation.chips import chip_document


def board(kind: str, seed: int) -> tuple[dict, dict[str, np.ndarray]]:
    """Return the estimate of one board, and what is true: rotation vectors in deg, lever arm, time offset."""
    rng = np.random.default_rng([seed, 20])
    Q = Rotation.random(random_state=seed).as_matrix()
    r, delay = rng.uniform(-0.05, 0.05, 3), rng.uniform(-0.005, 0.005) * (kind == "hand")
    if kind == "hand":
        pair = draw_chip(rng, np.eye(3), np.zeros(3)), draw_chip(rng, Q, r, delay)
        chips, turned = hand_board(rng, pair, by_hand(rng)), Q
    else:
        mounted, place = Rotation.from_rotvec(rng.uniform(-0.03, 0.03, 3)).as_matrix(), rng.uniform(-0.03, 0.03, 3)
        pair = draw_chip(rng, mounted, place), draw_chip(rng, Q @ mounted, place + r)
        chips, turned = table_board(rng, pair, dict.fromkeys("xyz", (60.0, 120.0, -120.0))), np.eye(3)
    truth = {"rotation": turned, "axes_rotation": Q, "lever_arm": r, "time_offset": delay}
    return chip_document(*chips), truth


def errors(found: dict, truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the error of each parameter; those of a rotation vector to the nearer of its two signs at half a turn."""
    out = {}
    for kind in ("rotation", "axes_rotation"):
        v, w = (Rotation.from_matrix(np.array(R)).as_rotvec() for R in (found[kind], truth[kind]))
        w = w if v @ w >= 0 else w * (1.0 - 2.0 * np.pi / np.linalg.norm(w))
        out |= {f"{kind}_{a}": e for a, e in zip("xyz", np.degrees(v - w), strict=True)}
    for i, a in enumerate("xyz"):
        out[f"lever_arm_{a}"] = found["parameters"][f"lever_arm_{a}"]["value"] - truth["lever_arm"][i]
    for sensor in ("accelerometer", "gyroscope"):
        name = f"time_offset_{sensor}"
        out[name] = found["parameters"][name]["value"] - truth["time_offset"]
    return out


def main() -> int:
    """Print the coverage of each kind of parameter, by hand and on a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boards", type=int, default=200, help="of each way of moving")
    parser.add_argument("--way", choices=("hand", "table"), action="append", help="default: both")
    arguments = parser.parse_args()
    for way in arguments.way or ("hand", "table"):
        rows, doubts = [], 0
        for seed in range(arguments.boards):
            found, truth = board(way, seed)
            doubts += bool(found["doubts"])
            for name, error in errors(found, truth).items():
                expanded = found["parameters"][name]["expanded_uncertainty"]
                rows.append((name.rstrip("xyz").rstrip("_"), abs(error), expanded))
        print(f"{way}: {arguments.boards} boards, {doubts} in doubt")
        for kind in dict.fromkeys(name for name, *_ in rows):
            error, expanded = np.array([row[1:] for row in rows if row[0] == kind]).T
            share, n = float(np.mean(error <= expanded)), len(error)
            half = 1.96 * np.sqrt(share * (1 - share) / n)
            within = f"coverage {100 * share:.1f} % +- {100 * half:.1f} of {n}"
            sizes = f"median U {np.median(expanded):.2g}, rms error {np.sqrt(np.mean(error**2)):.2g}"
            print(f"  {kind:26s} {within}; {sizes}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
