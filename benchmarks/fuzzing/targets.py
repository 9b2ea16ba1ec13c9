"""The list of all fuzz targets. Names seed the cases and appear in the table."""

from fuzzing import artifacts, captures, paths, policies, settings, tables, verbs
from fuzzing.cases import Target

TARGETS = (
    Target("scene.toml", 10, settings.scene),
    Target("robot.toml", 4, settings.robot),
    Target("overrides", 5, settings.overrides),
    Target("transforms", 6, captures.transforms),
    Target("colmap text", 4, captures.colmap_text),
    Target("colmap binary", 4, captures.colmap_binary),
    Target("image", 8, captures.image),
    Target("exif", 4, captures.exif),
    Target("film", 4, captures.film),
    Target("bag", 5, captures.bag),
    Target("results", 4, tables.results),
    Target("episodes", 4, tables.episodes),
    Target("training", 3, tables.training),
    Target("log csv", 4, tables.log_csv),
    Target("log npz", 5, tables.log_npz),
    Target("policy folder", 6, policies.policy_folder),
    Target("onnx", 5, policies.onnx_file),
    Target("callable", 3, policies.callable_name),
    Target("zip", 2, policies.zip_file),
    Target("lighting", 4, artifacts.lighting),
    Target("built", 6, artifacts.stage_files),
    Target("parts", 4, artifacts.stage_parts),
    Target("forecast", 4, artifacts.forecast),
    Target("noted", 3, artifacts.run_metadata),
    Target("options", 6, settings.options),
    Target("train config", 4, settings.train_config),
    Target("actions", 4, settings.actions),
    Target("path", 8, paths.odd_path),
    Target("verb", 8, verbs.verb),
)
