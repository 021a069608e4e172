"""Entry in the rolling operation, and the owners of the cells at the entrance."""

from __future__ import annotations

import pytest
from attrs import define, field
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.allocation import MAX_EMPTY
from laneweave.sim_bridge.road.demand import Arrival, arrivals
from laneweave.sim_bridge.road.entry import EntryMeter
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.examples import examples

LANES = 3
COLUMN_S = 1.0
LATTICE = Lattice(15.0, 15.0, 3.5, LANES, 4)
SMALL_S = 1e-6


@st.composite
def streams(draw: st.DrawFn, headway_s: float = 0.0) -> list[Arrival]:
    """Arrivals on all lanes, at least a headway apart on each."""
    stream = []
    for lane in range(LANES):
        t_s = 0.0
        for number, gap_s in enumerate(draw(st.lists(st.floats(0.0, 5.0), max_size=12))):
            t_s += headway_s + gap_s
            stream.append(Arrival(f"v{lane}-{number}", lane, draw(st.integers(0, 2)), t_s))
    return sorted(stream, key=lambda arrival: arrival.t_s)


def rolling_meter() -> EntryMeter:
    return EntryMeter(LATTICE, COLUMN_S / 2)


# --- the meter --------------------------------------------------------------------------------


@given(streams(headway_s=COLUMN_S))
@examples(100)
def test_a_vehicle_one_column_behind_its_predecessor_does_not_wait(stream: list[Arrival]) -> None:
    meter = rolling_meter()
    for arrival in stream:
        meter.demand(arrival)
    admissions = meter.admit(150.0)
    assert len(admissions) == len(stream)
    for admission in admissions:
        assert admission.t_s == pytest.approx(admission.arrival.t_s, abs=SMALL_S)


def test_a_vehicle_that_arrives_too_close_waits() -> None:
    meter = rolling_meter()
    for number in range(3):
        meter.demand(Arrival(f"v{number}", 0, 0, 0.4 + 0.1 * number))
    entries = [(admission.cell, admission.t_s) for admission in meter.admit(10.0)]
    assert entries == [((0, 0), 0.4), ((-1, 0), pytest.approx(1.4)), ((-2, 0), pytest.approx(2.4))]


def test_a_column_closes_when_no_vehicle_can_enter_it() -> None:
    meter = rolling_meter()
    closed = [1]
    for tick in range(40):
        meter.admit(tick * 0.1)
        closed.append(meter.closed_columns()[1])
        assert LATTICE.passing_time_s(closed[-1]) + COLUMN_S / 2 <= tick * 0.1 + SMALL_S
    assert closed == sorted(closed, reverse=True)
    assert closed[-1] == -3
    meter.demand(Arrival("late", 1, 0, 0.0))
    (admission,) = meter.admit(4.0)
    assert admission.cell == (-4, 1)


def test_in_the_paper_s_operation_cells_farther_ahead_are_caught_up_with() -> None:
    paper = parse_scenario({"formation": {"operation": "paper"}})
    assert paper.formation.entry_spread_s == 1.5 * COLUMN_S
    rolling = parse_scenario({"formation": {"operation": "rolling"}})
    assert rolling.formation.entry_spread_s == COLUMN_S / 2


# --- cells at the entrance --------------------------------------------------------------------


def make_scenario(**formation: object) -> Scenario:
    return parse_scenario({"formation": {"operation": "rolling", **formation}})


@define
class Entrance:
    """A roadside with a given demand, and all vehicles that have entered."""

    stream: list[Arrival]
    scenario: Scenario = field(factory=make_scenario)
    tick_s: float = 0.1
    roadside: Roadside = field(init=False)
    vehicles: dict[Name, RoadVehicle] = field(factory=dict)
    tick: int = 0

    def __attrs_post_init__(self) -> None:
        """Make the roadside."""
        self.roadside = Roadside(self.scenario, self.stream)

    def run(self, until_s: float) -> Entrance:
        while self.tick * self.tick_s <= until_s:
            t_s = self.tick * self.tick_s
            for admission in self.roadside.admit(t_s):
                vehicle = RoadVehicle.entering(admission, t_s, self.scenario)
                self.vehicles[vehicle.name] = vehicle
            self.roadside.assign_empty_cells(self.vehicles)
            self.tick += 1
        return self

    def owned(self, name: str) -> list[Cell]:
        return sorted(self.vehicles[Name(name)].controller.record.owned, reverse=True)

    def owners(self) -> dict[Cell, Name]:
        owners: dict[Cell, Name] = {}
        for name, vehicle in self.vehicles.items():
            for cell in vehicle.controller.record.owned:
                assert cell not in owners, f"{cell} is of {owners[cell]} and of {name}"
                owners[cell] = name
        return owners


@pytest.mark.slow
@given(streams(), st.sampled_from([0.1, 0.3, 1.0, 2.5]))
@examples(60)
@pytest.mark.more
def test_every_cell_near_a_vehicle_has_an_owner(stream: list[Arrival], tick_s: float) -> None:
    entrance = Entrance(stream, tick_s=tick_s).run(120.0)
    assert len(entrance.vehicles) == len(stream)
    owners = entrance.owners()
    for lane in range(LANES):
        columns = sorted(
            (vehicle.admission.cell[0], name)
            for name, vehicle in entrance.vehicles.items()
            if vehicle.admission.cell[1] == lane
        )
        for index, (column, name) in enumerate(columns):
            rear = columns[index - 1][0] if index else column - MAX_EMPTY - 1
            for each in range(column, max(rear, column - MAX_EMPTY - 1), -1):
                assert owners[each, lane] == name

    # Every other cell near a vehicle has some owner, also on lanes without entries, and ahead.
    entered = [vehicle.admission.cell[0] for vehicle in entrance.vehicles.values()]
    for column in range(MAX_EMPTY, -100, -1):
        if any(0 <= one - column <= MAX_EMPTY for one in entered):
            assert all((column, lane) in owners for lane in range(LANES)), column


def test_cells_ahead_of_the_first_vehicle_are_its_as_far_as_they_are_near() -> None:
    entrance = Entrance([Arrival("first", 1, 0, 20.2)]).run(20.3)
    owned = entrance.owned("first")
    assert owned[0][0] == -20 + MAX_EMPTY
    assert {lane for _, lane in owned} == {0, 1, 2}


def test_a_cell_is_assigned_when_no_vehicle_can_enter_it() -> None:
    entrance = Entrance([Arrival("first", 1, 0, 0.0)]).run(1.4)
    assert min(entrance.owned("first")) == (0, 0)
    entrance.run(1.6)
    assert min(entrance.owned("first")) == (-1, 0)


def test_most_get_no_more_than_some_cells() -> None:
    entrance = Entrance([Arrival("first", 1, 0, 0.0), Arrival("next", 1, 0, 50.0)]).run(60.0)
    assert min(entrance.owned("first"))[0] == -MAX_EMPTY
    assert max(entrance.owned("next"))[0] == -50 + MAX_EMPTY


def test_cells_behind_a_departed_vehicle_have_no_owner() -> None:
    entrance = Entrance([Arrival("first", 1, 0, 0.0)]).run(3.0)
    gone = entrance.vehicles.pop(Name("first"))
    owned = gone.controller.record.owned
    entrance.run(8.0)
    assert gone.controller.record.owned == owned
    assert entrance.owners() == {}


def test_where_formations_own_blocks_nothing_is_assigned_to() -> None:
    entrance = Entrance([Arrival("first", 1, 0, 0.0)], make_scenario(operation="paper")).run(9.0)
    assert entrance.owned("first") == []


def test_a_whole_demand_enters_without_waiting() -> None:
    scenario = parse_scenario(
        {
            "formation": {"operation": "rolling"},
            "demand": {"volume_veh_per_lane_h": 2000.0, "min_headway_s": 1.0, "duration_s": 60.0},
        }
    )
    stream = list(arrivals(scenario))
    entrance = Entrance(stream, scenario).run(62.0)
    assert len(entrance.vehicles) == len(stream) > 60
    for vehicle in entrance.vehicles.values():
        admission = vehicle.admission
        assert admission.t_s == pytest.approx(admission.arrival.t_s, abs=SMALL_S)
