"""Fault files, presets, and the completeness of their reference."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from attrs import evolve

from laneweave.launch.faults.breakdowns import breakdowns_of
from laneweave.launch.faults.fault_file import (
    GROUPS,
    BreakdownFault,
    FaultSpec,
    Kill,
    LinkFault,
    Partition,
    Pause,
    load_faults,
    preset_names,
)
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.message_faults import MessageRule
from support.paper import PAPER
from support.tables import for_each

COORDINATORS = ("c1", "c2")
VEHICLES = ("v0001", "v0002")
PRESETS = ("blackout", "everything", "leader-chaos", "lossy10", "lossy50", "router-restart")


def load(tmp_path: Path, text: str) -> FaultSpec:
    path = tmp_path / "faults.toml"
    path.write_text(text, encoding="utf-8")
    return load_faults(path, COORDINATORS, VEHICLES)


def test_without_a_file_there_are_no_faults() -> None:
    assert load_faults(None, COORDINATORS) == FaultSpec()
    assert not FaultSpec()


def test_a_file_may_have_every_field(tmp_path: Path) -> None:
    found = load(
        tmp_path,
        """
        seed = 7
        [[messages]]
        topics = ["state", "plan"]
        loss = 0.1
        sender = "vehicle"
        from_s = 3
        until_s = 4.5
        [[kill]]
        at_s = 3
        [[kill]]
        target = "agent"
        count = 20
        between_s = [10, 30]
        restart_after_s = 2
        restart_share = 0.5
        [[kill]]
        target = "v0002"
        at_s = 1
        every_s = 2
        times = 3
        [[pause]]
        target = "c2"
        at_s = 1.5
        for_s = 2
        [[pause]]
        at_s = 1.5
        for_s = [0.1, 15]
        [[partition]]
        between = ["coordinators", "others"]
        from_s = 5
        until_s = 6
        [[link]]
        loss = 0.1
        [[link]]
        of = "bridge"
        loss = 0.05
        burst = 20
        from_s = 7
        until_s = 8
        [[link]]
        delay_s = 0.02
        jitter_s = 0.01
        """,
    )
    assert found == FaultSpec(
        seed=7,
        messages=(
            MessageRule(
                topics=("state", "plan"), loss=0.1, sender="vehicle", from_s=3.0, until_s=4.5
            ),
        ),
        kill=(
            Kill(at_s=3.0, target="leader"),
            Kill(
                target="agent",
                count=20,
                between_s=(10.0, 30.0),
                restart_after_s=2.0,
                restart_share=0.5,
            ),
            Kill(target="v0002", at_s=1.0, every_s=2.0, times=3),
        ),
        pause=(Pause(target="c2", at_s=1.5, for_s=2.0), Pause(at_s=1.5, for_s=(0.1, 15.0))),
        partition=(Partition(between=("coordinators", "others"), from_s=5.0, until_s=6.0),),
        link=(
            LinkFault(loss=0.1),
            LinkFault(of="bridge", loss=0.05, burst=20, from_s=7.0, until_s=8.0),
            LinkFault(delay_s=0.02, jitter_s=0.01),
        ),
    )
    assert [fault.groups for fault in found.link] == [GROUPS, ("bridge",), GROUPS]
    assert [fault.delays for fault in found.link] == [False, False, True]
    assert found


def test_rules_name_single_processes(tmp_path: Path) -> None:
    found = load(
        tmp_path,
        """
        [[messages]]
        loss = 1.0
        from = "c1"
        to = "v0002"
        [[messages]]
        delay_s = 0.2
        between = ["v0001", "v0002"]
        [[messages]]
        loss = 0.5
        from = "coordinator"
        receiver = "vehicle"
        """,
    )
    assert found.messages == (
        MessageRule(loss=1.0, sender="c1", receiver="v0002"),
        MessageRule(delay_s=0.2, between=("v0001", "v0002")),
        MessageRule(loss=0.5, sender="coordinator", receiver="vehicle"),
    )
    assert [rule.label for rule in found.messages] == [
        *("c1 to v0002", "v0001 and v0002", "coordinator to vehicle")
    ]
    tables = {"messages": [{"loss": 1.0, "from": "c1", "to": "v0002"}]}
    assert load_faults(tables, COORDINATORS, VEHICLES).messages == found.messages[:1]


def test_an_unknown_process_in_a_rule_has_its_line_and_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        load(tmp_path, '[[messages]]\nloss = 1\nfrom = "c3"')
    line = str(caught.value)
    assert line.startswith(
        "messages[0].from: got 'c3'; allowed: vehicle, coordinator, bridge, c1, "
    )
    assert "faults.toml:3" in line


@for_each(
    ("text", "field"),
    [
        ('[[messages]]\nto = "v0003"', "messages[0].to"),
        ('[[messages]]\nto = "vehicles"', "messages[0].to"),
        ('[[messages]]\nbetween = ["v0001", "v0003"]', "messages[0].between"),
        ('[[messages]]\nbetween = ["v0001"]', "messages[0].between"),
        ('[[messages]]\nbetween = ["v0001", "v0001"]', "messages[0].between"),
        ('[[messages]]\nbetween = ["v0001", "c1"]\nto = "c2"', "messages[0].between"),
        ('[[messages]]\nfrom = "c 1"', "messages[0].from"),
        ('[[kill]]\ntarget = "c3"\nat_s = 1.0', "kill[0].target"),
        ('[[kill]]\nat_s = 1.0\n[[kill]]\ntarget = ""\nat_s = 1.0', "kill[1].target"),
        ('[[pause]]\ntarget = "v0003"\nat_s = 1.0\nfor_s = 1', "pause[0].target"),
        ("[[kill]]", "kill[0].at_s"),
        ("[[kill]]\nat_s = -0.1", "kill[0].at_s"),
        ("[[kill]]\nat_s = inf", "kill[0].at_s"),
        ("[[kill]]\nat_s = true", "kill[0].at_s"),
        ("[[kill]]\nat_s = 1.0\nat_m = 1.0", "kill[0].at_m"),
        ("[[kill]]\nat_s = 1.0\nbetween_s = [1, 2]", "kill[0].between_s"),
        ("[[kill]]\nbetween_s = [2, 1]", "kill[0].between_s"),
        ("[[kill]]\nbetween_s = [1]", "kill[0].between_s"),
        ("[[kill]]\nbetween_s = [1, 2]\nevery_s = 1", "kill[0].every_s"),
        ("[[kill]]\nat_s = 1\nevery_s = 0", "kill[0].every_s"),
        ("[[kill]]\nat_s = 1\ntimes = 2", "kill[0].times"),
        ("[[kill]]\nat_s = 1\nevery_s = 1\ntimes = 0", "kill[0].times"),
        ("[[kill]]\nat_s = 1\ncount = 2", "kill[0].count"),
        ('[[kill]]\nat_s = 1\ntarget = "agent"\ncount = 0', "kill[0].count"),
        ("[[kill]]\nat_s = 1\nrestart_share = 0.5", "kill[0].restart_share"),
        ("[[kill]]\nat_s = 1\nrestart_after_s = 1\nrestart_share = 1.5", "kill[0].restart_share"),
        ("[kill]\nat_s = 1.0", "kill"),
        ("[[delay]]\nat_s = 1.0", "delay"),
        ("[[pause]]\nat_s = 1.0", "pause[0].for_s"),
        ("[[pause]]\nat_s = 1.0\nfor_s = 0", "pause[0].for_s"),
        ("[[pause]]\nat_s = 1.0\nfor_s = [2, 1]", "pause[0].for_s"),
        ("[[pause]]\nat_s = 1.0\nfor_s = [1, 2, 3]", "pause[0].for_s"),
        ('[[pause]]\nat_s = 1.0\nfor_s = "long"', "pause[0].for_s"),
        ("[[messages]]\nloss = 1.5", "messages[0].loss"),
        ('[[messages]]\ntopics = ["service"]', "messages[0].topics"),
        ("[[messages]]\nfrom_s = 3\nuntil_s = 3", "messages[0].until_s"),
        ('[[partition]]\nbetween = ["bridge"]', "partition[0].between"),
        ("[[link]]", "link[0].loss"),
        ("[[link]]\nloss = 0.0", "link[0].loss"),
        ("[[link]]\nloss = 1.5", "link[0].loss"),
        ("[[link]]\nloss = -0.1", "link[0].loss"),
        ("[[link]]\ndelay_s = -0.1", "link[0].delay_s"),
        ("[[link]]\ndelay_s = 11", "link[0].delay_s"),
        ("[[link]]\njitter_s = nan", "link[0].jitter_s"),
        ("[[link]]\ndelay_s = 0.1\nburst = 2", "link[0].burst"),
        ("[[link]]\nloss = 0.1\nburst = 0", "link[0].burst"),
        ("[[link]]\nloss = 0.6\nburst = 2", "link[0].burst"),
        ("[[link]]\nloss = 0.0001", "link[0].loss"),
        ('[[link]]\nloss = 0.1\nof = "others"', "link[0].of"),
        ("[[link]]\nloss = 0.1\nfrom_s = 2\nuntil_s = 1", "link[0].until_s"),
        ('[[partition]]\nbetween = ["bridge", "bridge"]', "partition[0].between"),
        ('[[partition]]\nbetween = ["others", "bridge"]', "partition[0].between"),
        ('[[partition]]\nbetween = ["router", "others"]', "partition[0].between"),
        ('[[partition]]\nbetween = ["bridge", "others"]\nmethod = "magic"', "partition[0].method"),
        (
            '[[partition]]\nbetween = ["bridge", "vehicles"]\nmethod = "namespaces"',
            "partition[0].method",
        ),
        ("seed = -1", "seed"),
    ],
)
def test_an_error_names_the_field(tmp_path: Path, text: str, field: str) -> None:
    with pytest.raises(BadInputError) as caught:
        load(tmp_path, text)
    assert str(caught.value).startswith(f"{field}: got ")


def test_an_error_lists_the_allowed_targets(tmp_path: Path) -> None:
    allowed = "allowed: leader, c1, c2, coordinator, router, bridge, agent"
    with pytest.raises(BadInputError, match=allowed):
        load(tmp_path, '[[kill]]\ntarget = "bride"\nat_s = 1.0')


@for_each(
    ("text", "field", "reason"),
    [
        ("[[kill]]\nat_s = 1\nrestart_after_s = 1", "kill[0].restart_after_s", "another road"),
        ("[[kill]]\nat_s = 1\nevery_s = 1", "kill[0].every_s", "another road"),
        ("[[kill]]\nbetween_s = [1, 2]\ntimes = 2", "kill[0].times", "another road"),
        ("[[kill]]\nat_s = 1\ncount = 2", "kill[0].count", "1, or a target"),
        ("[[pause]]\nat_s = 1\nfor_s = 1", "pause[0].target", "stops the road"),
    ],
)
def test_the_bridge_can_be_killed_once(tmp_path: Path, text: str, field: str, reason: str) -> None:
    with pytest.raises(BadInputError) as caught:
        load(tmp_path, f'{text}\ntarget = "bridge"')
    assert caught.value.field == field
    assert reason in str(caught.value)
    assert load(tmp_path, '[[kill]]\nat_s = 1\ntarget = "bridge"').kill[0].target == "bridge"


# --- partitions -----------------------------------------------------------------------------------


def routes(partition: Partition) -> set[tuple[str | None, str | None]]:
    return {(rule.sender, rule.receiver) for rule in partition.message_rules()}


def test_a_partition_of_two_groups_loses_messages_both_ways() -> None:
    partition = Partition(between=("vehicles", "coordinators"), from_s=5.0, until_s=8.0)
    assert routes(partition) == {("vehicle", "coordinator"), ("coordinator", "vehicle")}
    for rule in partition.message_rules():
        assert (rule.loss, rule.topics, rule.from_s, rule.until_s) == (1.0, (), 5.0, 8.0)
    assert not partition.may_use_links


def test_messages_within_a_separated_group_arrive() -> None:
    partition = Partition(between=("vehicles", "others"))
    assert routes(partition) == {
        *(("vehicle", "coordinator"), ("coordinator", "vehicle")),
        *(("vehicle", "bridge"), ("bridge", "vehicle")),
    }
    assert partition.may_use_links
    assert not Partition(between=("vehicles", "others"), method="messages").may_use_links


def test_a_partition_has_a_window() -> None:
    partition = Partition(between=("bridge", "others"), from_s=5.0, until_s=8.0)
    assert [partition.holds(t_s) for t_s in (4.9, 5.0, 7.9, 8.0)] == [False, True, True, False]
    assert Partition(between=("bridge", "others")).holds(1e6)


def test_a_simulated_network_loses_no_packets() -> None:
    with pytest.raises(BadInputError, match=r"link: .*no packets"):
        FaultSpec(link=(LinkFault(loss=0.1),)).check_simulated()


@for_each(
    ("faults", "field"),
    [
        ({"messages": [{"loss": 1.0}]}, "messages"),
        ({"partition": [{"between": ["bridge", "others"]}]}, "partition"),
        ({"link": [{"loss": 0.1}]}, "link"),
        ({"kill": [{"target": "router", "at_s": 1}]}, "kill[0].target"),
        ({"kill": [{"at_s": 1, "restart_after_s": 1}]}, "kill[0].restart_after_s"),
        ({"pause": [{"target": "router", "at_s": 1, "for_s": 1}]}, "pause[0].target"),
    ],
)
def test_what_is_not_possible_from_outside_is_refused(faults: dict[str, Any], field: str) -> None:
    with pytest.raises(BadInputError, match="from outside") as caught:
        load_faults(faults, COORDINATORS).check_outside()
    assert caught.value.field == field


def test_kills_and_pauses_are_possible_from_outside() -> None:
    kills = [{"target": name, "at_s": 1} for name in ("leader", "c1", "v0001", "agent", "bridge")]
    faults = {"kill": kills, "pause": [{"at_s": 1, "for_s": 2}]}
    load_faults(faults, COORDINATORS).check_outside()


# --- presets --------------------------------------------------------------------------------------


def test_the_presets() -> None:
    assert preset_names() == PRESETS


@for_each("name", PRESETS)
def test_a_preset_loads_for_any_run(name: str) -> None:
    assert load_faults(name, ("c1",), ())


@for_each(
    ("name", "rule"),
    [
        ("lossy10", MessageRule(loss=0.1)),
        ("lossy50", MessageRule(loss=0.5)),
        ("blackout", MessageRule(loss=1.0, from_s=60.0)),
    ],
)
def test_presets_of_message_loss(name: str, rule: MessageRule) -> None:
    assert load_faults(name, COORDINATORS) == FaultSpec(messages=(rule,))


def test_an_unknown_name_gives_one_line_with_the_presets() -> None:
    with pytest.raises(BadInputError) as caught:
        load_faults("lossy99", COORDINATORS)
    line = str(caught.value)
    assert "--faults: got 'lossy99'" in line
    assert all(name in line for name in PRESETS)
    assert "\n" not in line


def test_a_file_takes_precedence_over_a_preset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lossy10").write_text("seed = 3\n", encoding="utf-8")
    assert load_faults("lossy10", COORDINATORS) == FaultSpec(seed=3)


# --- breakdowns -------------------------------------------------------------------------------


def test_a_breakdown_names_its_vehicle_or_says_which_ones(tmp_path: Path) -> None:
    found = load(
        tmp_path,
        """
        [[breakdown]]
        vehicle = "v0002"
        at_s = 3
        for_s = 20
        [[breakdown]]
        count = 3
        at_s = 5
        lane = 1
        at_m = 300
        decel_mps2 = 4
        """,
    )
    assert found.breakdown == (
        BreakdownFault(vehicle="v0002", at_s=3.0, for_s=20.0),
        BreakdownFault(count=3, at_s=5.0, lane=1, at_m=300.0, decel_mps2=4.0),
    )
    first, *others = breakdowns_of(found, PAPER)
    assert (first.vehicle, first.for_s) == ("v0002", 20.0)
    assert [(one.vehicle, one.lane, one.at_m, one.decel_mps2) for one in others] == [
        (None, 1, 300.0, 4.0)
    ] * 3
    assert all(math.isinf(one.for_s) for one in others)
    draws = [one.draw for one in others]
    assert len(set(draws)) == 3
    assert [one.draw for one in breakdowns_of(found, PAPER)[1:]] == draws
    assert [
        one.draw for one in breakdowns_of(found, evolve(PAPER, seed=PAPER.seed + 1))[1:]
    ] != draws


@for_each(
    ("text", "field"),
    [
        ('vehicle = "v0009"\nat_s = 1', "breakdown[0].vehicle"),
        ('vehicle = "v0001"\ncount = 2\nat_s = 1', "breakdown[0].count"),
        ("lane = 1", "breakdown[0].at_s"),
        ("at_s = 1\nlane = -1", "breakdown[0].lane"),
        ("at_s = 1\ndecel_mps2 = 0.1", "breakdown[0].decel_mps2"),
        ("at_s = 1\nfor_s = -1", "breakdown[0].for_s"),
        ("at_s = 1\ncount = 0", "breakdown[0].count"),
        ("at_s = nan", "breakdown[0].at_s"),
    ],
)
def test_a_wrong_breakdown_is_refused_with_its_field(tmp_path: Path, text: str, field: str) -> None:
    with pytest.raises(BadInputError) as refused:
        load(tmp_path, f"[[breakdown]]\n{text}\n")
    assert field in str(refused.value)
