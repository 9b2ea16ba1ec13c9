"""Camera positions on sampled places: films each place, builds to the stage `cameras`, and compares with the truth.

    python benchmarks/cameras.py WORK --places 60 61 62 [--json FILE]

WORK gets a scene per place, filmed in the first of its lightings; an existing film is used again. Errors are distances
of camera centers from the true ones after the similarity that fits best. A frame of a film that was left out counts as
missing.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from record import record_parser, save, write_so_far

from twin.geometry.cameras import Cameras
from twin.geometry.poses import umeyama
from twin.reality.place_sampling import sample_place
from twin.scene import SceneDir


def _run(*command: object) -> str:
    """Standard error of a command of twin, which may fail."""
    done = subprocess.run([sys.executable, "-m", *map(str, command)], capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no message"])[-1]


def measure(folder: Path) -> dict[str, Any]:
    """Errors [m] of the built cameras of a filmed place."""
    cameras = Cameras.load(SceneDir(folder).stage("cameras"))
    with np.load(folder / "truth" / "truth.npz", allow_pickle=False) as truth:
        true = []
        for source, seconds in zip(cameras.sources, cameras.times, strict=True):
            k = int(np.argmin(np.abs(truth[f"times_{source}"] - seconds)))
            true.append(truth[f"camera_to_world_{source}"][k, :3, 3])
    found, expected = cameras.camera_to_world[:, :3, 3], np.array(true)
    errors = np.linalg.norm(umeyama(found, expected).points(found) - expected, axis=1)
    report = json.loads((folder / "build" / "report.json").read_text())["cameras"]
    return {
        "registered": len(cameras),
        "total": report["total"],
        "films": len(set(cameras.sources)),
        "rms_m": round(float(np.sqrt(np.mean(errors**2))), 4),
        "worst_m": round(float(errors.max()), 4),
        "mapper": report.get("mapper"),
        "joined": report.get("joined"),
        "apart": report.get("apart"),
        "may_drift": report.get("may_drift"),
        "checked_steps": report.get("checked_steps"),
        "contradicted_steps": len(report.get("contradicted_steps") or []),
    }


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("work", type=Path, help="folder for the scenes")
    parser.add_argument("--places", type=int, nargs="+", required=True, metavar="NUMBER")
    parser.add_argument("--mapper", default="auto", help="cameras.mapper of the builds (default: auto)")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    failed = False
    for place in given.places:
        folder = given.work / f"place_{place}"
        if not (folder / "scene.toml").exists() and (
            error := _run(
                *(
                    "twin.reality",
                    "film",
                    "--place",
                    place,
                    "--out",
                    folder,
                    "--lightings",
                    sample_place(place).lights[0].name,
                )
            )
        ):
            print(f"place {place}: {error}", file=sys.stderr)
            return 1
        start = time.monotonic()
        error = _run("twin.build", folder, "--until", "cameras", "--set", f"cameras.mapper={given.mapper}")
        row = {"name": folder.name, "seconds": round(time.monotonic() - start)}
        rows.append(row | ({"error": error} if error else measure(folder)))
        print(json.dumps(rows[-1]), flush=True)
        failed = failed or bool(error)
        if given.json:  # after every place, so that an interrupted run keeps its figures
            write_so_far(given.json, {"places": rows})
    return save(given.json, {"places": rows}, given.replace_record) or int(failed)


if __name__ == "__main__":
    sys.exit(main())
