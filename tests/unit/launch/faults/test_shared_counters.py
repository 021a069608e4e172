"""The shared file: each process has its own counter, and all of them read the road time."""

from __future__ import annotations

from pathlib import Path

from laneweave.launch.faults.shared_counters import (
    LocalBoard,
    MessageFaults,
    ProcessBoard,
    SharedBoard,
)
from laneweave.protocol.runtime.message_faults import FaultBoard, FaultyCore, MessageRule, unwrapped


def test_road_time_passes_from_one_process_to_all(tmp_path: Path) -> None:
    board = SharedBoard(tmp_path / "board")
    assert board.road_s == 0.0
    bridge, early = (ProcessBoard(board.path, board.new_counter()) for _ in range(2))
    bridge.road_s = 12.5
    late = ProcessBoard(board.path, board.new_counter())
    assert (board.road_s, early.road_s, late.road_s) == (12.5, 12.5, 12.5)


def test_counters_add_up_when_processes_start_later(tmp_path: Path) -> None:
    board = SharedBoard(tmp_path / "board")
    assert board.dropped == 0
    boards: list[FaultBoard] = []
    for count in (3, 5, 7):
        boards.append(ProcessBoard(board.path, board.new_counter()))
        boards[-1].dropped += count
    assert [each.dropped for each in boards] == [3, 5, 7]
    boards[0].dropped += 1
    assert board.dropped == 16


def test_a_local_board_is_a_fault_board() -> None:
    board: FaultBoard = LocalBoard()
    board.dropped += 1
    assert (board.road_s, board.dropped) == (0.0, 1)


class _Silent:
    wakeup_s = None

    def handle(self, *_: object) -> tuple[()]:
        return ()


def test_a_role_process_puts_message_faults_before_its_core(tmp_path: Path) -> None:
    board = SharedBoard(tmp_path / "board")
    faults = MessageFaults(
        rules=(MessageRule(loss=1.0),),
        board=board.path,
        counter=board.new_counter(),
        receiver="vehicle",
        names=("v1",),
        seed="1/agent-v1/1",
    )
    core = _Silent()
    assert isinstance(faults.wrap(core), FaultyCore)
    assert unwrapped(core) is core
