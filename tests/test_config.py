import pytest

from twin.config import load_config
from twin.errors import InputError

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
    text = _MINIMAL + 'camera = {model="PINHOLE", params=[1, 2.5], width=4, height=3}\ncamera_height=2\n'
    config = load_config(_write(tmp_path, text))
    assert config.source[0].camera.params == (1.0, 2.5)
    assert config.source[0].camera_height == 2.0 and isinstance(config.source[0].camera_height, float)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_MINIMAL + "[nerf]\nstep = 3\n", "did you mean 'steps'"),
        (_MINIMAL + "[nerf]\nsteps = 'many'\n", "expected int, got 'many'"),
        (_MINIMAL + "[nerf]\nsteps = true\n", "expected int, got True"),
        (_MINIMAL + "[nerf]\nsteps = 0\n", "expected at least 1"),
        (_SOURCE + "[metric]\ncamera_height = nan\n", "got nan"),
        (_SOURCE + "[metric]\ncamera_height = -1.0\n", "camera_height = -1"),
        (_SOURCE, "no scale"),
        (_SOURCE + "[metric]\ncamera_height = 1.0\ngps = true\n", "camera_height and gps"),
        (_MINIMAL + 'kind = "film"\n', "expected auto, video"),
        ("[[source]]\n", "no path"),
        ("seed = 1\n", "no [[source]]"),
        ("seed = -1\n" + _MINIMAL, "seed = -1; expected 0 to 2147483647"),
        ("seed = 2147483648\n" + _MINIMAL, "seed = 2147483648; expected 0 to 2147483647"),
        ("seed = \n", "not valid TOML"),
        ("[source]\npath='a'\n", "expected a list"),
    ],
)
def test_bad_input_is_one_line_with_a_cure(tmp_path, text, message):
    with pytest.raises(InputError) as error:
        load_config(_write(tmp_path, text))
    assert message in str(error.value) and "\n" not in str(error.value)


def test_missing_file_names_the_verb_that_writes_one(tmp_path):
    with pytest.raises(InputError, match=r"twin\.new"):
        load_config(tmp_path / "scene.toml")


def test_overrides(tmp_path):
    path = _write(tmp_path, _MINIMAL)
    config = load_config(path, ("nerf.steps=7", "metric.up=cameras", "seed=3"))
    assert (config.nerf.steps, config.metric.up, config.seed) == (7, "cameras", 3)
    for bad in ("nerf.steps", "nerf.stepz=1", "=1", "seed.x=1"):
        with pytest.raises(InputError):
            load_config(path, (bad,))
