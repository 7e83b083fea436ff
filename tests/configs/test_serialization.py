"""Configs survive the way to JSON and back; what cannot be understood is refused by name."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any, get_args, get_type_hints

import pytest

from cotap.configs import BASE_RECIPES, BaseTraining, from_plain, to_plain


@dataclass
class Inner:
    size: int = 1
    span: tuple[float, float] = (0.0, 1.0)


@dataclass
class Outer:
    name: str = "outer"
    inner: Inner = field(default_factory=Inner)
    widths: tuple[int, ...] = (4, 2)


def change_all(config: Any) -> Any:
    """A copy in which every leaf differs from its default."""
    changes: dict[str, Any] = {}
    hints = get_type_hints(type(config))
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            changes[f.name] = change_all(value)
        elif isinstance(value, bool):
            changes[f.name] = not value
        elif isinstance(value, tuple):
            changes[f.name] = tuple(v + type(v)(1) for v in value) or (get_args(hints[f.name])[0](1),)
        else:
            changes[f.name] = value + type(value)(1)
    return dataclasses.replace(config, **changes)


def leaves(config: Any) -> list[Any]:
    out: list[Any] = []
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        out += leaves(value) if dataclasses.is_dataclass(value) else [value]
    return out


@pytest.mark.parametrize("recipe", BASE_RECIPES)
def test_every_field_of_every_recipe_survives_json(recipe: str):
    training = BASE_RECIPES[recipe]()
    changed = change_all(training)
    same = [a == b for a, b in zip(leaves(training), leaves(changed), strict=True)]
    assert len(same) > 100
    assert not any(same)
    back = from_plain(BaseTraining, json.loads(json.dumps(to_plain(changed))))
    assert back == changed
    assert [type(v) for v in leaves(back)] == [type(v) for v in leaves(changed)]


@pytest.mark.parametrize("recipe", BASE_RECIPES)
def test_recipes_are_fresh_and_valid(recipe: str):
    one, other = BASE_RECIPES[recipe](), BASE_RECIPES[recipe]()
    one.env.gait.period_s = 99.0
    one.ppo.hidden = (1,)
    assert other == BASE_RECIPES[recipe]()
    for part in (other.env, other.ppo, other.runner):
        part.check()


def test_plain_data_is_dicts_and_lists():
    assert to_plain(Outer()) == {"name": "outer", "inner": {"size": 1, "span": [0.0, 1.0]}, "widths": [4, 2]}


def test_missing_fields_take_their_defaults():
    assert from_plain(Outer, {"inner": {"size": 3}}) == Outer(inner=Inner(size=3))


def test_unknown_field_is_named_with_the_known_ones():
    with pytest.raises(ValueError, match="Outer has no field 'sise'; known: name, inner, widths"):
        from_plain(Outer, {"sise": 3})
    with pytest.raises(ValueError, match="Inner has no field 'with'; known: size, span"):
        from_plain(Outer, {"inner": {"with": 3}})
    with pytest.raises(ValueError, match="LowerRewards has no field 'track_velosity'"):
        from_plain(BaseTraining, {"env": {"rewards": {"lower": {"track_velosity": 1.0}}}})


def test_plain_data_are_copies():
    training = BASE_RECIPES["default"]()
    plain = to_plain(training)
    plain["ppo"]["hidden"].append(7)
    plain["env"]["num_envs"] = 7
    assert training == BASE_RECIPES["default"]()
