"""Figures: they show the numbers they are given, follow the page's colors, and cannot break the page."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D

from twin.assets.ground import Ground
from twin.report import figures


class _Ids(HTMLParser):
    """Collects ids and what refers to them, and checks that tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.referred: set[str] = set()
        self.open: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)
        self._look(attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look(attrs)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data.strip())

    def _look(self, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name == "xlink:href" and (value or "").startswith("#"):
                self.referred.add((value or "")[1:])
            else:
                self.referred |= set(re.findall(r"url\(#([^)]+)\)", value or ""))


def parsed(svg: str) -> _Ids:
    parser = _Ids()
    parser.feed(svg)
    assert not parser.open
    return parser


def every_figure() -> dict[str, figures.Figure]:
    rng = np.random.default_rng(0)
    route = np.stack([np.linspace(0, 20, 50), np.sin(np.linspace(0, 1, 50))], 1)
    positions = np.column_stack([route[::5], np.full(10, 1.5)])
    ground = Ground(
        rng.normal(size=(60, 80)),
        np.array([-5.0, -15.0]),
        0.5,
        np.ones((60, 80), bool),
        np.zeros((60, 80, 3), np.uint8),
    )
    parts = [np.array([[1.0, 2.0], [2.0, 2.0], [2.0, 3.0]])]
    points = rng.normal(size=(300, 3)) * 5
    colors = rng.integers(0, 255, (300, 3)).astype(np.uint8)
    half = np.arange(10) % 2 == 0
    return {
        "place": figures.place_map(positions, ["a"] * 5 + ["b"] * 5, half, points, colors, route, 1.0),
        "bare place": figures.place_map(positions, ["a"] * 10, half, points[:0], colors[:0]),
        "ground": figures.ground_map(ground, route, route, 1.0, parts),
        "branches": figures.ground_map(ground, route, route, 1.0, parts, {"side": route[:, ::-1]}),
        "place with branches": figures.place_map(
            positions, ["a"] * 10, half, points, colors, route, 1.0, (), {"side": route[:, ::-1]}
        ),
        "torn place": figures.place_map(
            positions, ["a"] * 10, half, points, colors, route, 1.0, contradicted=[(2, 3), (3, 4)]
        ),
        "bare ground": figures.ground_map(ground, route, None, 0.0, []),
        "training": figures.curve_chart({"": ([0, 10, 20], [10.0, 15.0, 17.0])}, "step", "PSNR [dB]"),
        "bars": figures.bar_chart({"day": 23.44, "night": 17.0}, {"day": 7}, "dB", "PSNR [dB]"),
        "histogram": figures.histogram(rng.gamma(2.0, 0.3, 500), "error [px]", "points", 4.0),
        "along": figures.curve_chart(
            {"x": ([0, 1, 2], [0.0, 0.1, 0.2]), "y": ([0, 1], [0.1, 0.1])}, "way [m]", "off [m]", 1.0, 0.0
        ),
        "rates": figures.rate_chart(["a", "b"], {"day": [("a", 0.5, 0.3, 0.7)], "night": [("b", 1.0, 0.8, 1.0)]}, "%"),
    }


@pytest.fixture(scope="module")
def drawn() -> dict[str, str]:
    return {name: figures.svg(figure) for name, figure in every_figure().items()}


def test_every_figure_is_well_formed_and_themed(drawn: dict[str, str]) -> None:
    for svg in drawn.values():
        assert svg.startswith("<svg") and svg.rstrip().endswith("</svg>")
        parser = parsed(svg)
        assert parser.referred <= set(parser.ids)  # nothing refers to an id that was dropped
        assert "var(--" in svg
        assert "#0a0b" not in svg  # every stand-in became a variable
        assert "http" not in svg  # nothing to fetch
        opening = svg[: svg.index(">")]
        assert "viewBox" in opening and " width=" not in opening and " height=" not in opening


def test_ids_are_unique_across_figures(drawn: dict[str, str]) -> None:
    ids = [i for svg in drawn.values() for i in parsed(svg).ids]
    assert len(ids) == len(set(ids)) > 0


def test_the_same_numbers_give_the_same_figure(drawn: dict[str, str]) -> None:
    again = {name: figures.svg(figure) for name, figure in every_figure().items()}
    assert again == drawn


def test_bars_say_their_values_and_counts(drawn: dict[str, str]) -> None:
    text = parsed(drawn["bars"]).text
    assert "23.4 dB (n = 7)" in text
    assert "17.0 dB" in text  # no count is known, and none is invented


def test_names_from_files_are_text() -> None:
    svg = figures.svg(figures.bar_chart({"<b>&$x_1$": 20.0}, {}, "dB", "PSNR"))
    assert "<b>" not in svg
    assert "<b>&$x_1$" in parsed(svg).text


@pytest.mark.filterwarnings("error")
def test_letters_that_matplotlib_lacks_are_left_to_the_browser() -> None:
    assert "夜" in parsed(figures.svg(figures.bar_chart({"夜": 20.0}, {}, "dB", "PSNR"))).text


def test_the_histogram_shows_the_median() -> None:
    svg = figures.svg(figures.histogram(np.array([1.0, 2.0, 2.5, 9.0, 100.0]), "px", "points", 4.0))
    assert "median 2.5 (n = 5)" in parsed(svg).text


def test_the_corridor_is_as_wide_as_it_says() -> None:
    route = np.stack([np.linspace(0, 10, 11), np.zeros(11)], 1)
    outline = figures.corridor_outline(route, 0.75)
    assert outline.shape == (22, 2)
    assert set(np.round(np.abs(outline[:, 1]), 9)) == {0.75}
    x, y = outline.T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert area == pytest.approx(10 * 1.5)


def test_a_legend_has_every_series_and_leaves_the_figure_its_size() -> None:
    """Matplotlib omits labels that begin with an underscore, as names of many cameras' files do."""
    names = ["_DSC0042", "_" + "long" * 20 + "1", *(f"film_{k:02d}" for k in range(20))]
    few, many = (
        figures.curve_chart({name: ([0, 1], [0.0, 1.0]) for name in shown}, "x", "y") for shown in (names[:2], names)
    )
    heights = []
    for figure in (few, many):
        FigureCanvasAgg(figure).draw()
        assert figure.axes[0].get_position().width > 0.7
        heights.append(figure.axes[0].get_position().height * figure.get_figheight())
    assert heights[1] == pytest.approx(heights[0], abs=0.1)
    labels = [text.get_text().strip() for text in many.legends[0].get_texts()]
    assert len(labels) == len(names) and labels[0] == names[0] and labels[1].endswith("1")


def test_twenty_films_look_different() -> None:
    names = [f"film_{k:02d}" for k in range(20)]
    positions, none = np.zeros((20, 3)), np.zeros((0, 3))
    figures_of = (
        figures.place_map(positions, names, np.zeros(20, bool), none, none),
        figures.curve_chart({name: ([0, 1], [0.0, 1.0]) for name in names}, "x", "y"),
    )
    for figure in figures_of:
        handles, labels = figure.axes[0].get_legend_handles_labels()
        looks = set()
        for handle, label in zip(handles, labels, strict=True):
            if label in names and isinstance(handle, Line2D):
                looks.add((handle.get_color(), str(handle.get_linestyle()), str(handle._dash_pattern)))
            elif label in names:
                looks.add((to_hex(handle.get_facecolor()[0]), handle.get_paths()[0].vertices.tobytes()))
                assert handle.get_sizes()[0] > 2.0
        assert len(looks) == len(names)


def test_bars_of_long_names_have_different_labels() -> None:
    names = [f"afternoon_of_the_first_day_{k}" for k in range(3)]
    figure = figures.bar_chart(dict.fromkeys(names, 20.0), {}, "dB", "PSNR [dB]")
    assert len({text.get_text() for text in figure.axes[0].get_yticklabels()}) == 3
