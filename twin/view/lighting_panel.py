"""The page's controls of the lighting: a slider through the field's lightings, sampling, and relighting by a photo."""

import itertools
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import viser

from twin.env.episode_lighting import EpisodeLighting
from twin.errors import InputError
from twin.files import exists
from twin.nerf.baked import BakedField
from twin.nerf.lightings import added_lightings
from twin.scene import check_name
from twin.view.camera_path import named_lighting
from twin.view.viewer import Viewer

_MAX_PHOTO = 60 << 20  # [bytes]


class LightingPanel:
    """The folder "Lighting"."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._field = viewer, viewer.field
        self._rng, self._sampled = np.random.default_rng(), 0
        self._pending: set[str] = set()  # names of photos that are being fitted; more may be dropped meanwhile
        gui = viewer.server.gui
        self._folder = gui.add_folder("Lighting")
        with self._folder:
            # viser's type of a handle declares no setter of `value`.
            self._slider: Any = self._add_slider(0.0)
            button = gui.add_button("Sample a lighting", hint="a plausible lighting that was never filmed", order=10.0)
            viewer.on_click(button, lambda event: self._sample())
            self._name = gui.add_text("Name", "", hint="name for the lighting that a photo adds", order=11.0)
            upload = gui.add_upload_button(
                "Relight by a photo",
                mime_type="image/*",
                hint="a photo of the place, from near the filmed path; or drop it on the page",
                order=12.0,
            )
            self._upload = upload
            upload.on_upload(lambda event: self._photo_given(upload.value.name, upload.value.content))

    def _add_slider(self, value: float) -> viser.GuiInputHandle[float]:
        """A slider through the field's lightings; it blends between neighbors."""
        names = self._field.lightings
        slider = self._viewer.server.gui.add_slider(
            "lighting",
            0.0,
            float(max(1, len(names) - 1)),
            0.01,
            value,
            marks=tuple((float(k), name) for k, name in enumerate(names)),
            disabled=len(names) < 2,
            hint="blends from each lighting to the next",
            order=0.0,
        )
        self._viewer.on_update(slider, self._slid)
        return slider

    def _slid(self) -> None:
        self._viewer.set_lighting(slider_lighting(self._field, float(self._slider.value)))

    def choose(self, name: str) -> None:
        """Moves the slider to a lighting of the field, and shows it."""
        self._slider.value = float(self._field.lightings.index(name))
        self._slid()

    def _sample(self) -> None:
        embedding = self._field.sample_lighting(self._rng)
        self._sampled += 1
        self._viewer.set_lighting(EpisodeLighting(f"sampled lighting {self._sampled}", embedding))

    def _photo_given(self, name: str, content: bytes) -> None:
        with self._viewer.locked():
            if len(content) > _MAX_PHOTO:
                raise InputError(f"{name}: {len(content) >> 20} MB; expected a photo of at most {_MAX_PHOTO >> 20} MB")
            lighting = self._name.value.strip() or self._unused_name(Path(name).stem)
            check_name(lighting, "name")
            self._upload.disabled = True
            self._pending.add(lighting)
            text = f"{name}: finding its camera pose and fitting its lighting; this takes about a minute."
            self._viewer.notify("Relighting", text)
            self._viewer.submit(self._relight, lighting, Path(name).suffix, content)

    def _unused_name(self, stem: str) -> str:
        """A name made from a photo's; numbered if it exists, as phones upload every photo as "image.jpg"."""
        stem, folder = "".join(c if c.isalnum() else "_" for c in stem), self._viewer.twin.scene.lightings
        taken = {*self._field.lightings, *self._pending}
        names = (f"{stem}_{k}" if k > 1 else stem for k in itertools.count(1))
        return next(one for one in names if one not in taken and not exists(folder / f"{one}.json"))

    def _relight(self, name: str, suffix: str, content: bytes) -> None:
        """Adds a photo's lighting by `twin relight` in another process, which frees its large memory when it ends."""
        root = str(self._viewer.twin.scene.root)
        try:
            with tempfile.TemporaryDirectory(prefix="twin-") as folder:
                photo = Path(folder) / f"photo{suffix}"
                photo.write_bytes(content)
                done = self._viewer.run([sys.executable, "-m", "twin.relight", root, str(photo), "--name", name])
            if self._viewer.closed.is_set():
                return
            with self._viewer.locked():
                if done.returncode:
                    last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
                    raise InputError(last.removeprefix("error: ").replace(str(photo), "the photo"))
                self._reload()
                self.choose(name)
                self._viewer.notify(f"Lighting {name} added", done.stdout.strip().splitlines()[1], "green")
        finally:
            self._pending.discard(name)
            self._upload.disabled = bool(self._pending)

    def _reload(self) -> None:
        """Reloads the lightings that photos have added to the scene."""
        filmed = self._field.lightings_by_name.filmed()
        added = added_lightings(self._viewer.twin.scene, filmed.vectors.shape[1])
        self._field.lightings_by_name = filmed.added(*added)
        value = min(float(self._slider.value), len(self._field.lightings) - 1.0)
        self._slider.remove()
        with self._folder:
            self._slider = self._add_slider(value)


def slider_lighting(field: BakedField, value: float) -> EpisodeLighting:
    """The lighting at a value of the slider: at an integer k the field's k-th, between integers a mixture of two."""
    names = field.lightings
    k = min(int(value), max(0, len(names) - 2))
    share = round(value - k, 4)
    if share <= 0.0 or len(names) == 1:
        return named_lighting(field, names[k])
    return named_lighting(field, names[k + 1] if share >= 1.0 else f"{names[k]}:{names[k + 1]}:{share:g}")
