import dataclasses
import math

import pytest

from twin import commands
from twin.config import CAMERA_MODELS, MARKER_FAMILIES, SceneConfig
from twin.config_file import _SECTIONS, load_config
from twin.errors import InputError
from twin.ranges import Range, check_range, setting_ranges

_SOURCE = '[[source]]\npath = "a.mp4"\n'
_MINIMAL = "metric.camera_height = 1.2\n" + _SOURCE


def _write(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


def test_defaults_and_name_from_folder(tmp_path):
    config = load_config(_write(tmp_path, _MINIMAL))
    assert config.name == tmp_path.name
    assert config.source[0].path == "a.mp4"
    assert config.source[0].camera is None


def test_nested_table_and_integer_for_float(tmp_path):
    text = _MINIMAL + 'camera = {model="PINHOLE", params=[1, 2.5, 3, 4], width=4, height=3}\ncamera_height=2\n'
    config = load_config(_write(tmp_path, text))
    assert config.source[0].camera.params == (1.0, 2.5, 3.0, 4.0)
    assert config.source[0].camera_height == 2.0 and isinstance(config.source[0].camera_height, float)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_MINIMAL + "[nerf]\nstep = 3\n", "did you mean 'steps'"),
        (_MINIMAL + "[nerf]\nsteps = 'many'\n", "expected int, got 'many'"),
        (_MINIMAL + "[nerf]\nsteps = true\n", "expected int, got True"),
        (_MINIMAL + "[nerf]\nsteps = 0\n", "expected at least 1"),
        (_SOURCE + "[metric]\ncamera_height = nan\n", "got nan"),
        (_SOURCE + "[metric]\ncamera_height = inf\n", "expected a finite number, got inf"),
        (_SOURCE + "[metric]\ncamera_height = -1.0\n", "camera_height = -1"),
        (_MINIMAL + "camera_height = 120\n", "camera_height of [[source]] 'a.mp4' = 120; expected 0 to 100"),
        ("seed = -1\n" + _MINIMAL, "seed = -1; expected 0 to 2,147,483,647"),
        (f"seed = {2**31}\n" + _MINIMAL, "seed = 2,147,483,648; expected"),
        (_SOURCE, "no scale"),
        (_MINIMAL + "[[branch]]\nname = 'side'\n", "[[branch]] 'side' has neither passes nor points"),
        (_MINIMAL + 2 * "[[branch]]\nname = 'side'\npasses = ['a']\n", "two routes are named 'side'"),
        (_MINIMAL + "[[branch]]\nname = 'route'\npasses = ['a']\n", "two routes are named 'route'"),
        (_MINIMAL + "[[branch]]\nname = 'side'\npoints = [[0]]\n", "[[branch]] 'side'.points = [[0.0]]; expected two"),
        (
            _MINIMAL + "[[task]]\nname = 'a'\nroute = 'side'\nlength = 3.0\n",
            "[[task]] route = 'side', but there is no [[branch]]",
        ),
        (
            _MINIMAL + "[[branch]]\nname = 'side'\npasses = ['a']\n[[obstacle]]\nkind = 'cone'\nroute = 'sied'\n",
            "[[obstacle]] route = 'sied'; did you mean 'side'?",
        ),
        (_MINIMAL + "[[branch]]\nname = 'side'\npasses = ['a']\n[mjcf]\nroute = false\n", "[[branch]] needs a route"),
        (_MINIMAL + "[route]\npoints = [[0, 0]]\n", "route.points = [[0.0, 0.0]]; expected two or more"),
        (_MINIMAL + "[route]\npasses = ['a:1']\npoints = [[0, 0], [1, 0]]\n", "route gives passes and points"),
        (_MINIMAL + "[capture]\nkeep = [[5, 3]]\n", "capture.keep = [[5.0, 3.0]]; expected pairs [from, to]"),
        (_MINIMAL + "keep = [[-1.0, 3]]\n", "keep of [[source]] 'a.mp4' = [[-1.0, 3.0]]; expected pairs"),
        (_MINIMAL + "keep = [[0, 3], [2, 4]]\n", "without overlap"),
        (_MINIMAL + "keep = [[0, 3, 4]]\n", "expected pairs"),
        (_MINIMAL + "keep = [0, 3]\n", "keep: expected a list, got 0"),
        (_MINIMAL + "keep = [[0, inf]]\n", "expected a finite number"),
        (_MINIMAL + 'kind = "film"\n', "expected auto, video"),
        (_MINIMAL + 'kind = "vidoe"\n', "did you mean 'video'"),
        (_MINIMAL + 'path = "a\\u0000.mp4"\n'.replace("path", "mask"), "without NUL"),
        (_MINIMAL + '[cameras]\nmapper = "incremntal"\n', "cameras.mapper = 'incremntal'; did you mean 'incremental'"),
        (_SOURCE + '[metric]\ncamera_height = 1\nup = ""\n', "metric.up = ''; expected ground, cameras or poses"),
        (_MINIMAL + 'lighting = "training"\n', "a lighting sampled at random"),
        (_MINIMAL + 'lighting = "a/b"\n', "choose a plain name"),
        (_MINIMAL + f'lighting = "{"x" * 90}"\n', "at most 80 characters"),
        (_MINIMAL + 'lighting = ".."\n', "must not be a dot"),
        (_MINIMAL + 'camera = {model = "PINHOL", params = [1, 2, 3, 4]}\n', "did you mean 'PINHOLE'"),
        (_MINIMAL + 'camera = {model = "OPENCV", params = [1, 2, 3, 4]}\n', "has 4 numbers; OPENCV has 8"),
        (_MINIMAL + "camera = {params = [1, 2, 3, 4], width = 9}\n", "is for 9x0 px"),
        ('metric.marker = {family = "DICT_4x4_5O", size = 1}\n' + _SOURCE, "did you mean 'DICT_4X4_50'"),
        ('metric.marker = {family = "DICT_4X4_50", id = 50, size = 1}\n' + _SOURCE, "id = 50; expected 0 to 49"),
        ('metric.marker = {family = "DICT_4X4_50", id = 1}\n' + _SOURCE, "size = 0; expected the side"),
        ("metric.distance = {a = [1, 2], b = [3, 4]}\n" + _SOURCE, "metres = 0; expected the meters"),
        ("metric.distance = {metres = 1, a = [1], b = [3, 4]}\n" + _SOURCE, "a = [1.0]; expected [u, v]"),
        ("metric.distance = {metres = 1, a = [1, 2], b = [3, 4]}\n" + _SOURCE, "frame_a = ''; expected a frame"),
        ('name = "a\\nb"\n' + _MINIMAL, "without control characters"),
        *(
            (_MINIMAL + f'[[task]]\nname = "{name}"\nlength = 5\n', "files are named after it")
            for name in ("a/b", "..", ".x", "a\\u0000", "x" * 81, " ", "\u6f22" * 60)
        ),
        (
            _MINIMAL + "[[task]]\nname = 'a'\nlength = 0.6\n",
            "length ≥ 1 [m]: a shorter task would be done at once",
        ),
        (_MINIMAL + 2 * '[[task]]\nname = "a"\nlength = 5\n', "two [[task]] are named 'a'"),
        (_MINIMAL + '[[obstacle]]\nkind = "cone"\nname = "a/b"\n', "files are named after it"),
        (_MINIMAL + '[[obstacle]]\nkind = "cone"\n[[obstacle]]\nkind = "box"\nname = "cone_0"\n', "named 'cone_0'"),
        ("[[source]]\n", "no path"),
        ("seed = 1\n", "no [[source]]"),
        ("seed = \n", "not valid TOML"),
        ("[source]\npath='a'\n", "expected a list"),
    ],
)
def test_bad_input_is_one_line_with_a_cure(tmp_path, text, message):
    with pytest.raises(InputError) as error:
        load_config(_write(tmp_path, text))
    assert message in str(error.value) and "\n" not in str(error.value)


def test_missing_file_suggests_the_verb_new(tmp_path):
    with pytest.raises(InputError, match="twin new"):
        load_config(tmp_path / "scene.toml")


def test_segments_of_films_are_read(tmp_path):
    config = load_config(_write(tmp_path, _MINIMAL + "keep = [[0, 3], [4.5, 6]]\n"), ("capture.keep=[[1, 2]]",))
    assert config.source[0].keep == ((0.0, 3.0), (4.5, 6.0)) and config.capture.keep == ((1.0, 2.0),)


def test_choices_match_the_libraries():
    cv2, lens = (pytest.importorskip(n) for n in ("cv2", "twin.capture.camera_models"))
    models = set(lens.pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"}
    assert set(CAMERA_MODELS) == models
    for name, count in CAMERA_MODELS.items():
        assert len(lens.pycolmap.Camera.create_from_model_name(0, name, 1.0, 10, 10).params) == count
    families = {name for name in dir(cv2.aruco) if name.startswith("DICT_")}
    assert set(MARKER_FAMILIES) <= families and {name.upper() for name in MARKER_FAMILIES} == {
        n.upper() for n in families
    }
    for name, count in MARKER_FAMILIES.items():
        assert len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList) == count


def test_overrides_replace_settings_of_the_file(tmp_path):
    path = _write(tmp_path, _MINIMAL)
    config = load_config(path, ("nerf.steps=7", "metric.up=cameras", "seed=3"))
    assert (config.nerf.steps, config.metric.up, config.seed) == (7, "cameras", 3)
    for bad in ("nerf.steps", "nerf.stepz=1", "nerf.steps=0", "=1", "seed.x=1"):
        with pytest.raises(InputError, match=f"--set '?{bad}"):
            load_config(path, (bad,))


def _numbers():
    """Section, key and default of every number that a stage reads."""
    config = SceneConfig()
    for section in _SECTIONS:
        for key, value in dataclasses.asdict(getattr(config, section)).items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                yield section, key, value


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (10**400, "steps = 1000"),
        (float("nan"), "steps = nan"),
        (True, "steps = True"),
        ("9", "steps = '9'"),
        (0, "steps = 0"),
    ],
)
def test_what_is_no_number_in_range_is_told(value: object, told: str) -> None:
    with pytest.raises(InputError, match=rf"^{told}.*; expected 1 to 10"):
        check_range(value, Range(1, 10), "steps")


def test_every_number_has_a_range_that_is_checked(tmp_path):
    path = _write(tmp_path, _MINIMAL)
    for section, key, default in _numbers():
        bounds = setting_ranges(type(getattr(SceneConfig(), section)))[key]
        low, high = bounds.low, bounds.high
        assert low <= default <= high
        kind = type(default)
        # The lens's height is the scale: none given is another error.
        allowed = [end for end in (low, high) if math.isfinite(end) and (section, end) != ("metric", 0)]
        for end in allowed:
            config = load_config(path, (f"{section}.{key}={kind(end)!r}",))
            assert getattr(getattr(config, section), key) == end
        for beyond in (low - 1, high + 1):
            if math.isfinite(beyond):
                with pytest.raises(InputError, match=rf"{section}\.{key} = .*; expected (at least )?{low:g}"):
                    load_config(path, (f"{section}.{key}={kind(beyond)!r}",))


def test_a_file_given_for_a_scene_is_one_line(tmp_path, capsys, monkeypatch):
    path = _write(tmp_path, _MINIMAL)
    (tmp_path / "README.md").write_text("no scene")
    for given, cure in ((path, f"give the folder of the scene, {tmp_path}"), (tmp_path / "README.md", "scenes/demo")):
        assert commands.main("build", [str(given)]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"error: {given} is a file; ") and cure in error and error.count("\n") == 1
    (tmp_path / "other/scene.toml").mkdir(parents=True)
    assert commands.main("build", [str(tmp_path / "other")]) == 2
    assert "is a folder; expected a file" in capsys.readouterr().err


@pytest.mark.parametrize("setting", ["nerf.bake_steps=0", "nerf.sightings=1.0", "nerf.levels=0", "mesh.views=0"])
def test_a_number_out_of_range_is_refused_before_the_build(tmp_path, capsys, setting):
    _write(tmp_path, _MINIMAL)
    assert commands.main("build", [str(tmp_path), "--set", setting]) == 2
    error = capsys.readouterr().err
    assert setting.split("=")[0] in error and "expected" in error and error.count("\n") == 1
    assert not (tmp_path / "build").exists()
