"""Reports of real runs: files, tables, and a page that needs no other file."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from attrs import evolve
from PIL import Image

from laneweave.launch.drawing.road_scene import road_scene
from laneweave.launch.recordings.runs import POINT_FILE, Comparison, runs_of, single_run
from laneweave.launch.report.page import Animation, Section, keep_units, render_page
from laneweave.launch.report.report import TOO_SHORT
from laneweave.launch.report.tables import Table, tables_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.recording.columns import SCENARIO_KEY
from support.commands import Here
from support.summaries import make_summary
from support.tables import for_each

ALWAYS = {"path_map.png", "spacing.png", "comfort.png"}
FIGURES = ALWAYS | {"speeds.png", "road-formation.png"}
RUN_FIGURES = ALWAYS | {"speed.png", "road.png"}
"""Figures of a run that is too short for counted vehicles."""


class Reader(HTMLParser):
    """Collects the contents of a page."""

    def __init__(self, page: Path) -> None:
        """Read a page."""
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self.data: list[dict[str, Any]] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        tag, attributes = self.elements[-1] if self.elements else ("", {})
        if tag == "script" and attributes.get("type") == "application/json":
            if data.strip():
                self.data.append(json.loads(data))
        else:
            self.texts.append(data)

    def every(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def check_page(page: Path, pictures: int) -> Reader:
    """Check that a page needs no other file, and return its contents."""
    reader = Reader(page)
    for tag, attributes in reader.elements:
        assert "src" not in attributes or tag == "img"
        assert "href" not in attributes or (attributes["href"] or "").startswith("#")
    images = reader.every("img")
    assert len(images) == pictures
    for image in images:
        assert (image["src"] or "").startswith("data:image/png;base64,iVBOR")
        assert len(image["alt"] or "") > 10
    assert len(reader.every("figcaption")) == pictures
    places = {attributes.get("id") for _, attributes in reader.elements}
    assert {(link["href"] or "")[1:] for link in reader.every("a")} <= places
    assert {
        player["data-animation"] for player in reader.every("div") if "data-animation" in player
    } == {one["id"] for one in reader.every("script") if one.get("type")}
    text = page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "url(" not in text
    assert "@import" not in text
    return reader


@pytest.mark.slow
@pytest.mark.more
def test_of_a_sweep(laneweave: Here, swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "a <b> & 'c'"  # a name that needs escaping
    shutil.copytree(swept, folder)
    assert laneweave("report", folder)[0] == 0
    assert {path.name for path in (folder / "figures").iterdir()} == FIGURES
    for name in FIGURES:
        with Image.open(folder / "figures" / name) as image:
            assert image.info["dpi"] == pytest.approx((300, 300), abs=1)
    reader = check_page(folder / "report.html", len(FIGURES))
    assert "laneweave: a <b> & 'c'" in reader.texts
    assert TOO_SHORT in reader.texts
    assert (folder / "report.html").stat().st_size < 6_000_000
    assert [one["title"] for one in reader.data] == ["formation, 1600 veh/(lane·h), seed 1"]


@pytest.mark.slow
def test_of_a_run(laneweave: Here, swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(swept / "formation-1600-1", folder)
    assert laneweave("report", folder, "--formation", 2, "--figures", "svg")[0] == 0
    assert {path.name for path in folder.glob("*.png")} == RUN_FIGURES
    assert {path.with_suffix(".png").name for path in folder.glob("*.svg")} == RUN_FIGURES
    reader = check_page(folder / "report.html", len(RUN_FIGURES))
    assert {"laneweave run: run", TOO_SHORT} <= set(reader.texts)
    assert len(reader.data) == 1


@pytest.mark.slow
@pytest.mark.more
def test_of_a_run_without_formations(laneweave: Here, swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(swept / "formation-1000-1", folder)
    for file, name in (("trips.parquet", "formation"), ("trajectories.parquet", "reserved_column")):
        whole = pq.read_table(folder / file)
        place = whole.schema.get_field_index(name)
        nothing = pa.nulls(whole.num_rows, whole.schema.field(name).type)
        pq.write_table(whole.set_column(place, whole.schema.field(name), nothing), folder / file)
    assert laneweave("report", folder)[0] == 0
    assert {path.name for path in folder.glob("*.png")} == RUN_FIGURES - {"path_map.png"}
    reader = check_page(folder / "report.html", len(RUN_FIGURES) - 1)
    assert {vehicle["formation"] for vehicle in reader.data[0]["vehicles"]} == {None}


@pytest.mark.slow
@pytest.mark.more
def test_of_several_runs(laneweave: Here, swept: Path, tmp_path: Path) -> None:
    folders = [tmp_path / "first", tmp_path / "second"]
    for folder in folders:
        shutil.copytree(swept / "formation-1600-1", folder)
    status, out, _ = laneweave("report", *folders, "--out", tmp_path / "both")
    assert (status, out.count(": written")) == (0, 3)
    texts = check_page(tmp_path / "both" / "report.html", len(FIGURES) + 1).texts
    # Same method, volume and seed: only their folders tell them apart.
    assert {"first", "second"} <= set(texts)


def test_a_run_of_a_sweep_keeps_its_label(swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(swept / "formation-1000-1", folder)
    data = json.loads((folder / POINT_FILE).read_text())
    (folder / POINT_FILE).write_text(json.dumps(data | {"label": "rolling"}))
    assert (single_run(folder).label, single_run(folder).method) == ("rolling", "formation")
    (folder / POINT_FILE).unlink()
    assert single_run(folder).label == "formation"


def test_runs_that_failed_are_listed_and_not_averaged(swept: Path, tmp_path: Path) -> None:
    out = tmp_path / "sweep"
    shutil.copytree(swept, out)
    record = out / "formation-1000-1" / POINT_FILE
    data = json.loads(record.read_text())
    record.write_text(json.dumps(data | {"status": "failed", "reason": "<its process ended>"}))
    comparison = Comparison.of(runs_of([out]))
    assert [run.volume_veh_per_lane_h for run in comparison.runs] == [1600.0]
    traffic, *_, failed = tables_of(comparison)
    assert failed.rows == [("formation", "1000", "1", "<its process ended>")]
    assert {row[1] for row in traffic.rows} == {"1600"}


@pytest.mark.slow
def test_trips_may_be_older_than_trajectories(laneweave: Here, swept: Path, tmp_path: Path) -> None:
    """As in a run that was killed between two saves."""
    folder = tmp_path / "run"
    shutil.copytree(swept / "formation-1600-1", folder)
    trips = pq.read_table(folder / "trips.parquet")
    pq.write_table(trips.slice(0, trips.num_rows // 2), folder / "trips.parquet")
    assert laneweave("report", folder)[0] == 0
    for format_ in ("csv", "fcd", "mcap"):
        assert laneweave("export", folder, "--format", format_)[0] == 0


def test_one_line_says_what_is_wrong(
    laneweave: Here, swept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("run", "unfinished", "short"):
        shutil.copytree(swept / "formation-1000-1", name)
    Path("unfinished", "summary.json").write_text('{"schema"')
    Path("short", "trips.parquet").unlink()
    for name in ("empty", "torn", "begun"):
        Path(name).mkdir()
    Path("torn", "trajectories.parquet").write_bytes(b"PAR1")
    Path("begun", "sweep.json").touch()
    for words, said in (
        ("missing", "folder: got 'missing'; allowed: the folder of a run"),
        ("empty", "folder: got 'empty'; allowed: the folder of a run"),
        ("torn", "folder: got 'torn'; allowed: the folder of a finished run"),
        ("short", "trips.parquet: got 'none in short'; allowed: a run that kept this file"),
        ("unfinished", "folder: got 'unfinished'; allowed: the folder of a finished run"),
        ("begun", "folder: got 'begun'; allowed: a sweep with a finished run"),
        ("run --formation 99", "--formation: got 99; allowed: a formation of run: "),
        ("run --out x", "--out: got 'x'; allowed: only with several folders"),
    ):
        assert said in laneweave.refused("report", *words.split())


@pytest.mark.parametrize(
    ("file", "damage", "of_sweep"),
    [
        ("events.jsonl", lambda content: content.replace(b'"kind"', b'"ki', 1), False),
        ("events.jsonl", lambda content: content.replace(b'"kind"', b'"ki', 1), True),
        ("events.jsonl", lambda content: content + b"[]", False),
        ("events.jsonl", lambda content: content + b'{"t_s": 1.0}', False),
        ("events.jsonl", lambda content: content + b'{"kind": "formation-closed"}\xff\n', False),
        ("events.jsonl", lambda _: b'{"kind": "formation-closed", "role": "bridge"}\n', False),
        ("events.jsonl", lambda _: b'{"kind": "part-closed"}\n', False),
        ("trips.parquet", lambda content: content[:100], True),
        ("trips.parquet", lambda content: content[:4] + bytes(len(content) - 4), True),
        ("trips.parquet", lambda content: content[:4] + bytes(1000) + content[1004:], False),
        ("trajectories.parquet", lambda content: content[:4] + bytes(999) + content[1003:], True),
    ],
)
def test_one_line_names_the_damaged_file(
    laneweave: Here,
    swept: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    damage: Callable[[bytes], bytes],
    of_sweep: bool,
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(swept, "sweep")
    damaged = Path("sweep", "formation-1600-1", file)
    damaged.write_bytes(damage(damaged.read_bytes()))
    said = laneweave.refused("report", "sweep" if of_sweep else damaged.parent)
    assert str(damaged.parent) in said
    assert file in said


def test_a_scenario_of_another_release_is_named_with_its_file(
    laneweave: Here, swept: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(swept / "formation-1000-1", folder)
    table = pq.read_table(folder / "trajectories.parquet")
    metadata = dict(table.schema.metadata)
    metadata[SCENARIO_KEY] = metadata[SCENARIO_KEY].replace(b'"gap_m"', b'"gap_of_later_m"')
    pq.write_table(table.replace_schema_metadata(metadata), folder / "trajectories.parquet")
    said = laneweave.refused("report", folder)
    assert "the scenario in trajectories.parquet" in said
    assert "gap_of_later_m" in said


def test_an_error_of_the_report_is_not_reported_as_bad_input(
    laneweave: Here, swept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise KeyError("a bug")

    monkeypatch.setattr("laneweave.launch.report.report.report_run", fail)
    with pytest.raises(KeyError, match="a bug"):
        laneweave("report", swept / "formation-1000-1")


def test_a_page_escapes_its_texts() -> None:
    road = road_scene(Scenario())
    texts = "</script><b>"
    page = render_page(
        texts,
        texts,
        [
            Section(
                texts,
                tables=[Table((texts, "n"), [(texts, "&")], texts)],
                animations=[Animation({"title": texts} | road)],
            )
        ],
    )
    assert texts not in page
    assert page.count("&lt;/script&gt;&lt;b&gt;") == 9
    assert page.count("</script>") == 2


def test_planning_times_of_a_comparison(swept: Path) -> None:
    runs = sorted(runs_of([swept]), key=lambda run: run.order)
    assert runs[-1].volume_veh_per_lane_h == 1600.0
    by_solver = {"tappa": 4, "branching": 1, "none": 0}
    runs[-1] = evolve(
        runs[-1],
        summary=make_summary(planning={"by_solver": by_solver, "fallbacks": 1, "plans": 5}),
    )
    *_, planning, _ = tables_of(Comparison.of(runs))
    assert planning.headings[2:4] == ("plans by branching", "plans by tappa")
    assert planning.rows[-1][2:] == ["1", "4", "6", "5", "1", "5.0", "10.0", "12.0"]
    runs[-1] = evolve(runs[-1], summary=make_summary(planning={"plans": 0}))
    *_, without, _ = tables_of(Comparison.of(runs))
    assert len(without.rows) == len(planning.rows) - 1


@for_each(
    ("text", "kept"),
    [
        ("66.01 / 67.35 s", "66.01 / 67.35_s"),
        ("9.88 m, 0.94 s", "9.88_m, 0.94_s"),
        ("70.1 ± 0.3", "70.1_±_0.3"),
        ("91 (100.00 %)", "91_(100.00_%)"),
        ("no preferred lanes", "no preferred lanes"),
    ],
)
def test_numbers_stay_on_a_line_with_their_units(text: str, kept: str) -> None:
    assert keep_units(text) == kept.replace("_", "\u00a0")
