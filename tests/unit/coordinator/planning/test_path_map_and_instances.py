"""The relative path map, and the families of instances."""

import pytest

from laneweave.coordinator.planning.path_map import RelativePathMap, final_arrival
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import (
    block_request,
    formation_request,
    traffic_request,
)


def test_paths_are_padded_with_their_last_cell() -> None:
    path_map = RelativePathMap.padded(["a", "b"], [[(0, 0)], [(1, 0), (2, 0), (2, 1)]])
    assert path_map.rows == (((0, 0),) * 3, ((1, 0), (2, 0), (2, 1)))
    assert path_map.steps == 2
    assert path_map.cost() == 2


def test_text() -> None:
    path_map = RelativePathMap.padded(["1", "lorry"], [[(0, 0), (1, 0)], [(10, 2)]])
    assert str(path_map) == (
        "Vehicle ID  step 0  step 1\n1           (0,0)   (1,0)\nlorry       (10,2)  (10,2)"
    )


@pytest.mark.parametrize(
    ("path", "arrival"),
    [
        ([(0, 0)], 0),
        ([(0, 0), (0, 0)], 0),
        ([(0, 0), (1, 0), (1, 0)], 1),
        ([(0, 0), (1, 0), (0, 0), (0, 0)], 2),
    ],
)
def test_only_the_final_arrival_counts(path: list[tuple[int, int]], arrival: int) -> None:
    assert final_arrival(path) == arrival


def test_path_map_of_a_response() -> None:
    request = block_request(0, deadline_s=60.0)
    response = plan(request)
    path_map = response.path_map(request.ids)
    assert path_map.cost() == response.cost
    assert path_map.steps == response.steps
    assert path_map.ids == tuple(vehicle.id for vehicle in request.vehicles)


class TestInstances:
    def test_block_family(self) -> None:
        request = block_request(7)
        assert (request.grid.columns, request.grid.lanes) == (4, 3)
        assert [v.cell for v in request.vehicles] == [
            (0, 0), (0, 2), (1, 1), (2, 0), (2, 2), (3, 1),
        ]  # fmt: skip
        for lane in range(3):
            columns = [c for c, target_lane in request.targets if target_lane == lane]
            count = sum(vehicle.lane == lane for vehicle in request.vehicles)
            first = (4 - count) // 2
            assert columns == list(range(first, first + count))

    @pytest.mark.parametrize("vehicles", [1, 6, 9, 24])
    def test_formation_family_has_spare_columns(self, vehicles: int) -> None:
        for seed in range(10):
            request = formation_request(seed, vehicles=vehicles)
            columns = [vehicle.cell[0] for vehicle in request.vehicles]
            assert 2 <= min(columns) <= 4
            assert 2 <= request.grid.columns - 1 - max(columns) <= 5
            assert len(request.targets) == vehicles

    def test_seeds_give_different_but_repeatable_requests(self) -> None:
        requests = [formation_request(seed) for seed in range(20)]
        assert requests == [formation_request(seed) for seed in range(20)]
        assert len({str(request) for request in requests}) > 15

    def test_vehicles_that_do_not_fit_are_rejected(self) -> None:
        with pytest.raises(ValueError, match="do not fit"):
            block_request(0, vehicles=7)


def test_traffic_fills_formations_of_every_length() -> None:
    requests = [traffic_request(seed) for seed in range(200)]
    assert {request.grid.columns for request in requests} == {3, 4, 5, 6, 7}
    assert {len(request.vehicles) for request in requests} <= {3, 4, 5, 6}
    for request in requests:
        cells = [vehicle.cell for vehicle in request.vehicles]
        lanes = [vehicle.lane for vehicle in request.vehicles]
        assert len(set(cells)) == len(cells)
        assert all(lanes.count(lane) <= request.grid.columns for lane in lanes)
        assert sorted(lane for _, lane in request.targets) == sorted(
            lane for lane in lanes if lane is not None
        )
        # A formation that is not full is as long as it may be, or has no room for the next column.
        assert len(cells) >= 4 or request.grid.columns == 7
    assert traffic_request(7) == requests[7]
