"""From films to a drivable twin, on a small stretch of the simulated reality: every stage, for real."""

import json
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest
import warp as wp

import twin
from twin import build as verb
from twin import commands
from twin.reality.__main__ import TINY, film
from twin.scene import STAGE_FOLDERS

pytestmark = pytest.mark.slow  # all share one build of minutes

QUICK = (
    "nerf.steps=120",
    "nerf.rays=1024",
    "nerf.max_width=240",
    "nerf.log2_table=16",
    "nerf.bake_steps=20",
    "nerf.detail_passes=0.25",
    "nerf.max_bricks=1500",
    "mesh.margin=8",
    "mesh.views=30",
    "mesh.view_width=120",
    "review.fps=3",
    "review.width=240",
    "review.renders=12",
)


def _command(root, *options):
    settings = [word for setting in QUICK for word in ("--set", setting)]
    return [sys.executable, "-m", "twin.build", str(root), *settings, *options]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    root = tmp_path_factory.mktemp("tiny") / "scene"
    film(replace(TINY, samples=1, fps=2), root)  # as many frames as a build keeps
    done = subprocess.run(_command(root), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert commands.main("reality", ["compare", str(root)]) == 0
    return root, done.stdout


def test_every_stage_ran_and_the_report_has_its_keys(built):
    root, printed = built
    report = json.loads((root / "build/report.json").read_text())
    assert list(report["stages"]) == list(STAGE_FOLDERS) and all(s["seconds"] > 0 for s in report["stages"].values())
    assert report["cameras"]["registered"] >= 0.9 * report["cameras"]["total"]
    assert report["cameras"]["reprojection_error_px"] < 1.5
    assert report["metric"]["scale_source"] == "camera_height"
    assert set(report["field"]["psnr"]) == {"sun", "overcast"}
    assert report["mesh"]["parts"] > 0 and report["mjcf"]["route_length_m"] > 6
    assert report["review"]["follower"]["touched"] == [] and report["review"]["follower"]["reached_goal"]
    assert report["peak_memory_bytes"] > 1e8 and report["versions"]["torch"] and report["seed"] == 0
    assert "goal reached" in printed and "touched nothing" in printed


def test_the_twin_agrees_with_the_truth(built):
    root, _ = built
    truth = json.loads((root / "build/report.json").read_text())["truth"]
    assert truth["ate_m"] < 0.08 and truth["ate_max_m"] < 0.30
    assert abs(truth["scale_error"]) < 0.05  # a dozen meters and quick settings; the demo is held to 2 %
    assert truth["ground_median_m"] < 0.08


def test_the_pictures_beat_a_flat_color(built):
    """A field that learned nothing scores about as much as the mean color; this one must score more."""
    root, _ = built
    field = json.loads((root / "build/report.json").read_text())["field"]
    assert all(value > 17 for value in field["psnr"].values()), field["psnr"]


def test_the_video_plays_and_the_page_is_self_contained(built):
    root, _ = built
    page = (root / "build/report.html").read_text()
    assert "data:image/" in page and "http://" not in page.replace("http://www.w3.org", "")
    import av

    with av.open(str(root / "build/review.mp4")) as film:
        stream = film.streams.video[0]
        assert stream.codec_context.name == "h264" and stream.codec_context.pix_fmt == "yuv420p"
        assert sum(1 for _ in film.decode(stream)) > 20


def test_scene_loads_in_plain_mujoco_after_zipping(built, tmp_path):
    root, _ = built
    archive = shutil.make_archive(str(tmp_path / "scene"), "zip", root / "build/5_mjcf")
    with zipfile.ZipFile(archive) as file:
        file.extractall(tmp_path / "elsewhere")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "elsewhere/scene.xml"))
    data = mujoco.MjData(model)
    for _ in range(100):
        mujoco.mj_step(model, data)
    assert model.nu >= 2 and abs(data.qvel[:3]).max() < 0.05


def test_a_second_build_has_nothing_to_do(built):
    root, _ = built
    report = verb.build(root, overrides=QUICK)
    assert all(stage["skipped"] for stage in report["stages"].values())


def test_the_twin_opens_with_its_field_world_and_cameras(built):
    root, _ = built
    scene = twin.load_scene(root)
    assert set(scene.field().lightings) == {"sun", "overcast"}
    assert scene.world().model().nu >= 2 and len(scene.cameras()) > 20
    with pytest.raises(twin.InputError, match="no scene"):
        twin.load_scene(root / "input")


def test_the_benchmark_of_the_field_runs(built, tmp_path):
    root, _ = built
    script, file = Path(__file__).parents[1] / "benchmarks/field.py", tmp_path / "figures.json"
    sections = ["bake", "render", "depth", "train"]
    command = [sys.executable, str(script), "--quick", "--scene", str(root), "--json", str(file), "--only", *sections]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads(file.read_text())
    assert abs(figures["bake.psnr_drop"]) < 10 and figures["bake.bytes"] > 1e5
    assert figures["render.fps_1core"] > 0 and figures["render.ratio_to_nerfacto"] > 0
    assert figures["render.nerfacto_s"] > 0 and figures["render.ratio_to_nerfacto_tuned"] > 0
    assert 0 < figures["render.first_frame_s"] < figures["render.first_frame_cold_s"]
    assert 0 < figures["depth.median_error_m"] < 5 and figures["train.peak_bytes"] > 1e8
    assert all(name in done.stdout for name in figures if name != "about")


def test_it_is_driven_by_what_it_sees(built, tmp_path):
    """In the environment of a real build, pictures show the field, the goal is reached, and a film is written."""
    from twin.env.drivers import RouteDriver
    from twin.env.episode import record_episode

    root, _ = built
    environment = twin.load(root, "route", 0, lighting="overcast")
    seen = []
    episode = record_episode(environment, RouteDriver(), lambda step: seen.append(step.observation["pixels"][-1]))
    assert episode.success and episode.trust.min() > 0.5
    field, world = twin.load_scene(root).field(), environment.task.world
    view = twin.Viewpoints.of(environment.physics.camera_to_world, world.intrinsics, (160, 90))
    wanted = field.render(view, "overcast").rgb[0] * 255
    assert abs(seen[-1] - wanted).mean() < 1.0
    film = tmp_path / "drive.mp4"
    command = [sys.executable, "-m", "twin.film", str(root), "--task", "route", "--out", str(film), "--obstacles", "0"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "goal after" in done.stdout and film.stat().st_size > 1e4, done.stderr[-3000:]


def test_the_benchmark_of_the_environment_runs(built, tmp_path):
    root, _ = built
    script, file = Path(__file__).parents[1] / "benchmarks/env.py", tmp_path / "figures.json"
    sections = ["speed", "memory", "driver", "audit", "soak", "trust", "host", "gpu"]
    command = [sys.executable, str(script), "--quick", "--scene", str(root), "--json", str(file), "--only", *sections]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads(file.read_text())
    assert figures["single.steps_per_s"] > 1 and figures["batch8.steps_per_s"] > 1
    assert figures["driver.success"] == 1.0 and figures["driver.blind.route"] <= 1.0  # a dozen nearly straight meters
    assert figures["soak.not_finite"] == 0 and figures["audit.false_successes"] == 0
    assert figures["trust.pictures"] > 10
    assert figures["host.steps_per_s"] > 1
    assert figures["gpu.steps_per_s"] > 1 if wp.is_cuda_available() else "no CUDA device" in figures["gpu.none"]
