"""Reports of real runs: what is written, and that the page needs nothing else."""

from __future__ import annotations

import json
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from laneweave.launch.cli import main as cli
from laneweave.launch.report.runs import Comparison, runs_of
from laneweave.launch.report.tables import (
    failed_table,
    mean_and_spread,
    planning_table,
    table,
    traffic_table,
)
from laneweave.launch.sweep.folder import POINT_FILE

FIGURES = {
    "travel_times.png",
    "flows.png",
    "speeds.png",
    "road-formation.png",
    "path_map.png",
    "spacing.png",
    "comfort.png",
}
RUN_FIGURES = {
    "travel_time.png",
    "speed.png",
    "road.png",
    "path_map.png",
    "spacing.png",
    "comfort.png",
}


class Reader(HTMLParser):
    """Collects what is on a page."""

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
    """Check that a page needs no other file, and return what is on it."""
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


def report(*arguments: object) -> int:
    return cli._status(["report", *map(str, arguments)])


def test_of_a_sweep(swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "a <b> & 'c'"  # a name that needs escaping
    shutil.copytree(swept, folder)
    assert report(folder) == 0
    assert {path.name for path in (folder / "figures").iterdir()} == FIGURES
    for name in FIGURES:
        with Image.open(folder / "figures" / name) as image:
            assert image.info["dpi"] == pytest.approx((300, 300), abs=1)
    reader = check_page(folder / "report.html", len(FIGURES))
    assert "laneweave: a <b> & 'c'" in reader.texts
    assert (folder / "report.html").stat().st_size < 6_000_000
    assert [one["title"] for one in reader.data] == ["formation, 1600 veh/(lane·h), seed 1"]


def test_of_a_run(swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(swept / "formation-1600-1", folder)
    assert report(folder, "--formation", 2) == 0
    assert {path.name for path in folder.glob("*.png")} == RUN_FIGURES
    reader = check_page(folder / "report.html", len(RUN_FIGURES))
    assert "laneweave run: run" in reader.texts
    assert len(reader.data) == 1


def test_of_a_run_without_formations(swept: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(swept / "formation-1000-1", folder)
    for file, name in (("trips.parquet", "formation"), ("trajectories.parquet", "column")):
        whole = pq.read_table(folder / file)
        place = whole.schema.get_field_index(name)
        nothing = pa.nulls(whole.num_rows, whole.schema.field(name).type)
        pq.write_table(whole.set_column(place, whole.schema.field(name), nothing), folder / file)
    assert report(folder) == 0
    assert {path.name for path in folder.glob("*.png")} == RUN_FIGURES - {"path_map.png"}
    reader = check_page(folder / "report.html", len(RUN_FIGURES) - 1)
    assert {vehicle["formation"] for vehicle in reader.data[0]["vehicles"]} == {None}


def test_of_several_runs(swept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [tmp_path / "first", tmp_path / "second"]
    for folder in folders:
        shutil.copytree(swept / "formation-1600-1", folder)
    assert report(*folders, "--out", tmp_path / "both") == 0
    assert capsys.readouterr().out.count(": written") == 3
    texts = check_page(tmp_path / "both" / "report.html", len(FIGURES) + 1).texts
    # Same method, volume and seed: only their folders tell them apart.
    assert {"first", "second"} <= set(texts)


def test_runs_that_failed_are_listed_and_not_averaged(swept: Path, tmp_path: Path) -> None:
    out = tmp_path / "sweep"
    shutil.copytree(swept, out)
    record = out / "formation-1000-1" / POINT_FILE
    data = json.loads(record.read_text())
    record.write_text(json.dumps(data | {"status": "failed", "reason": "<its process ended>"}))
    comparison = Comparison.of(runs_of([out]))
    assert [run.volume_veh_per_lane_h for run in comparison.runs] == [1600.0]
    assert "&lt;its process ended&gt;" in failed_table(comparison)
    assert ">1000<" not in traffic_table(comparison)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["missing"], "DIR: got 'missing'; allowed: the folder of a run"),
        (["empty"], "DIR: got 'empty'; allowed: the folder of a run"),
        (["torn"], "DIR: got 'torn'; allowed: the folder of a finished run"),
        (["unfinished"], "DIR: got 'unfinished'; allowed: the folder of a finished run"),
        (["begun"], "DIR: got 'begun'; allowed: a sweep with a finished run"),
        (["run", "--formation", "99"], "--formation: got 99; allowed: a formation of run: "),
        (["run", "--out", "x"], "--out: got 'x'; allowed: only with several folders"),
    ],
)
def test_one_line_says_what_is_wrong(
    swept: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(swept / "formation-1000-1", "run")
    shutil.copytree(swept / "formation-1000-1", "unfinished")
    Path("unfinished", "summary.json").write_text('{"schema"')
    for name in ("empty", "torn", "begun"):
        Path(name).mkdir()
    Path("torn", "trajectories.parquet").write_bytes(b"PAR1")
    Path("begun", "sweep.json").touch()
    assert report(*arguments) == 2
    shown = capsys.readouterr()
    assert (shown.out, len(shown.err.splitlines())) == ("", 1)
    assert said in shown.err


def test_tables_escape_what_is_in_them() -> None:
    html = table(("<h>", "n"), [("<script>", "&")], "<c>")
    assert "<script>" not in html
    assert "&lt;script&gt;" in html
    assert "&lt;h&gt;" in html
    assert "&lt;c&gt;" in html


def test_means_with_their_spread() -> None:
    assert mean_and_spread([1.0, 3.0, None], 2) == "2.00 ± 1.41"
    assert mean_and_spread([1.0], 1) == "1.0"
    assert mean_and_spread([None], 1) == "-"


def test_planning_times_of_a_comparison(swept: Path) -> None:
    comparison = Comparison.of(runs_of([swept]))
    (run,) = comparison.at("formation", 1600.0)
    planning = run.summary["planning"]
    assert "by_solver" not in planning or planning["by_solver"]
    planning |= {"by_solver": {"tappa": 4, "branching": 1, "none": 0}, "fallbacks": 1, "plans": 5}
    text = planning_table(comparison)
    cells = [f"<td>{value}</td>" for value in ("5", "1", f"{planning['solve_ms']['p50']:.1f}")]
    assert "<td>branching 1, tappa 4</td>" in text
    assert "".join(cells) in text
    planning |= {"plans": 0}
    assert text.count("<tr>") == planning_table(comparison).count("<tr>") + 1
