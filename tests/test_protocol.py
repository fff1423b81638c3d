"""Protocols: METHOD's numbers, and errors for YAML that is not one."""

import copy
import dataclasses

import pytest
import yaml

from dexgrasp.config import conf_folder
from dexgrasp.errors import DexgraspError
from dexgrasp.simulation.protocol import load_protocol


@pytest.fixture
def config() -> dict:
    return yaml.safe_load((conf_folder() / "protocol" / "lift-v1.yaml").read_text())


def test_lift_v1_is_method_section_5() -> None:
    protocol = load_protocol("lift-v1")
    physics, motion = protocol.physics, protocol.motion
    assert (physics.friction, physics.torsional_friction, physics.density) == (0.6, 0.02, 500)
    assert (physics.mass_min, physics.mass_max, motion.lift, motion.hold) == (0.05, 1, 0.30, 2)
    assert str(protocol) == "lift-v1 (version 3)"


def test_cmgnet_code_is_method_section_5() -> None:
    protocol = load_protocol("cmgnet-code")
    assert (protocol.physics.friction, protocol.physics.mass_min, protocol.physics.mass_max) == (100, 0.001, 0.001)
    assert protocol.motion.overdrive == pytest.approx(0.0872665, abs=1e-6)
    assert (protocol.motion.lift, protocol.verdict.rise, protocol.verdict.max_tilt) == (0.2, 0.133, 30)
    assert protocol.verdict.stop_at == 1


def test_bulk_is_lift_v1_in_longer_steps() -> None:
    """The same hand, friction, masses and forces; what differs is how time is cut and how high it lifts."""
    bulk, reference = load_protocol("lift-bulk-v1"), load_protocol("lift-v1")
    differs = {
        field.name
        for group in ("physics", "motion", "verdict")
        for field in dataclasses.fields(getattr(bulk, group))
        if getattr(getattr(bulk, group), field.name) != getattr(getattr(reference, group), field.name)
    }
    assert differs == {"timestep", "contact_time", "leap", "sleep", "lift", "lift_time", "rise", "alongside"}
    for share in ("rise", "alongside"):
        told = [getattr(p.verdict, share) / p.motion.lift for p in (bulk, reference)]
        assert told[0] == pytest.approx(told[1], rel=0.01)
    jerks = [p.motion.lift / p.motion.lift_time**2 for p in (bulk, reference)]
    assert jerks[0] == pytest.approx(jerks[1], rel=0.01)


def differences(name: str) -> dict:
    """What a protocol has otherwise than lift-v1."""
    values, reference = load_protocol(name).values(), load_protocol("lift-v1").values()
    return {
        key: value
        for group in ("physics", "motion", "verdict")
        for key, value in values[group].items()
        if value != reference[group][key]
    }


def test_transport_and_shake_are_lift_v1_and_more() -> None:
    for name, part in (("transport-v1", "transport"), ("shake-v1", "shake")):
        assert differences(name) == {}
        assert set(load_protocol(name).values()) == {*load_protocol("lift-v1").values(), part}


def test_dexgraspbench_is_method_section_5() -> None:
    assert differences("dexgraspbench") == {
        "mass_min": 0.1, "mass_max": 0.1, "gravity": 0.0, "timestep": 0.004, "contact_time": 0.008, "intrusion": 0.01,
        "grip_effort": 0.6,
    }  # fmt: skip
    rule = load_protocol("dexgraspbench").disturbance
    assert (rule.force, rule.distance, rule.angle, rule.apart, rule.closing) == (10, 0.05, 15, True, True)


def test_isaac_dro_is_method_section_5() -> None:
    assert differences("isaac-dro").items() >= {"friction": 3.0, "gravity": 0.0, "mass_min": 0.0}.items()
    rule = load_protocol("isaac-dro").disturbance
    assert (rule.force, rule.distance, rule.angle, rule.apart, rule.closing) == (0.5, 0.02, None, False, False)


def test_parts_that_are_not_there_do_not_change_a_protocol(config: dict) -> None:
    assert load_protocol(config | {"shake": None}) == load_protocol("lift-v1")
    assert "shake" not in load_protocol("lift-v1").values()
    with pytest.raises(DexgraspError, match="shake"):
        load_protocol(config | {"shake": {"period": 1.0}})
    with pytest.raises(DexgraspError, match="table"):
        load_protocol("isaac-dro").on_table("a test")


def test_a_protocol_in_a_file_of_ones_own(tmp_path, config: dict) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(config | {"name": "mine"}))
    assert load_protocol(str(path)).name == "mine"
    path.write_text("- 1")
    with pytest.raises(DexgraspError, match="keys of a protocol"):
        load_protocol(str(path))


NAMES = sorted(path.stem for path in (conf_folder() / "protocol").glob("*.yaml"))


@pytest.mark.parametrize("name", NAMES)
def test_every_number_stands_in_the_yaml_and_old_configs_mean_the_same(name: str) -> None:
    config = yaml.safe_load((conf_folder() / "protocol" / f"{name}.yaml").read_text())
    protocol = load_protocol(config)
    newer = ("alongside", "leap", "sleep", "synergy_effort")
    for group in ("physics", "motion", "verdict"):
        fields = dataclasses.fields(getattr(protocol, group))
        assert list(config[group]) == [field.name for field in fields]
        for field in fields:
            if field.default is not dataclasses.MISSING and field.name not in newer:
                assert config[group].pop(field.name) == field.default
    assert load_protocol(config) == protocol


def test_wrong_keys_and_values_are_told(config: dict) -> None:
    def fails(change, words: str) -> None:
        wrong = copy.deepcopy(config)
        change(wrong)
        with pytest.raises(DexgraspError, match=words):
            load_protocol(wrong)

    load_protocol(config)
    fails(lambda c: c["physics"].update(fricton=1), "fricton")
    fails(lambda c: c["motion"].pop("lift"), "lift")
    fails(lambda c: c["motion"].update(lift="high"), "motion.lift")
    fails(lambda c: c["physics"].update(friction=-1.0), "physics.friction")
    fails(lambda c: c["physics"].update(gravity=float("nan")), "physics.gravity")
    fails(lambda c: c["verdict"].update(exclusive=1), "verdict.exclusive")
    fails(lambda c: c["verdict"].update(look=0.0), "verdict.look: a number above 0")
    fails(lambda c: c["verdict"].update(pushed="far"), "verdict.pushed: a number of at least 0")
    fails(lambda c: c.update(motion=3), "motion")


def test_unknown_name_lists_the_known() -> None:
    with pytest.raises(DexgraspError, match="lift-v1"):
        load_protocol("lift-v9")
