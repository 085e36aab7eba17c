"""Write ``docs/generated/catalogue.md``, which the page of effects includes: ``python docs/catalogue.py``."""

from __future__ import annotations

import inspect
from pathlib import Path

import mujoco
import numpy as np

from torchrl_athletic.effects import CATALOGUE, FIT_TRIMS, TRIMS, Effect, JointAddress, Parameter, Plant

PAGE = Path(__file__).parent / "generated" / "catalogue.md"
HINGE, SLIDE = (
    mujoco.MjModel.from_xml_string(f"""
    <mujoco><worldbody><body><joint name="joint" {kind}/>
      <inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>""")
    for kind in ('axis="0 1 0"', 'type="slide" axis="1 0 0"')
)
CHAIN = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body><joint name="before" axis="0 1 0"/>
      <inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.01"/>
      <body><joint name="joint" axis="0 1 0"/>
        <inertial pos="0 0 -0.2" mass="1" diaginertia="0.01 0.01 0.01"/></body></body></worldbody></mujoco>""")
"""For what a joint has of the one before it."""


def page() -> str:
    """All effects and trims: two tables of them, and a section for each."""
    found = {e.name for e in CATALOGUE}
    trims = [e for e in FIT_TRIMS if e.name not in found]
    parts = [overview(), tolerances(), *(section(effect) for effect in (*CATALOGUE, *trims))]
    return "\n".join(parts).lstrip()


def overview() -> str:
    """A row for each effect."""
    rows = [
        f"| {e.family} | [{e.name}](#{e.name}) | `{_cell(e.equation)}` | {parameters(e)} | {e.shows_in} |"
        for e in CATALOGUE
    ]
    head = "| class | effect | equation | parameters [hinge; slide] | shows along |"
    return "\n".join(["", head, "|---|---|---|---|---|", *rows, ""])


def tolerances() -> str:
    """A row for each trim."""
    rows = [
        f"| [{e.name}](#{e.name}) | {tolerance(e)} | {'naming and fit' if e in TRIMS else 'fit'} |" for e in FIT_TRIMS
    ]
    return "\n".join(["\n### Trims\n", "| trim | tolerance, either way | moves in |", "|---|---|---|", *rows, ""])


def tolerance(effect: Effect) -> str:
    """By how much a trim may move: percent of the given number, or of the link's size where that is zero."""
    p, share = _parameters(effect, HINGE)[0], effect.tolerance
    if p.nominal:
        return f"{100 * share * p.scale / p.nominal:.2g} %"
    if effect.name == "link_com_shift":
        return f"{100 * share * p.scale / p.upper:.2g} % of the link's size along each axis"
    of_hinge, of_slide = (_parameters(effect, model)[0] for model in (HINGE, SLIDE))
    both = [f"{1e3 * share * q.scale:.2g} m{q.unit}" for q in (of_hinge, of_slide)]
    return "; ".join(dict.fromkeys(both))


def section(effect: Effect) -> str:
    """Everything that the catalogue knows of one effect."""
    said = {"Summary": "", "Parameters": "", "Fingerprint": "", "Simulation": "", "Notes": ""}
    for paragraph in (inspect.getdoc(type(effect)) or "").split("\n\n"):
        head, _, rest = paragraph.partition(": ")
        key = head.partition(",")[0]  # "Parameters, in total"
        if not said["Summary"]:
            said["Summary"] = _line(paragraph)
        elif key in said:
            said[key] = _line(f"{head.removeprefix(key).removeprefix(',').strip()}: {rest}".removeprefix(": "))
        else:
            said["Notes"] = _line(f"{said['Notes']} {paragraph}")
    if effect.whole_robot:
        said["Notes"] = f"{said['Notes']} It belongs to the whole robot, so that its finding names no joint.".strip()
    lines = [f"\n### {effect.name}\n", said["Summary"] + (f" {said['Notes']}" if said["Notes"] else ""), ""]
    lines += [
        f"- **Equation:** `{effect.equation}`",
        f"- **Parameters:** {said['Parameters']}",
        f"- **Fingerprint:** {said['Fingerprint']} Shows along {effect.shows_in}.",
        f"- **Simulation:** {said['Simulation']} Changes {_listed(changes(effect))}.",
    ]
    if effect.identical_to:
        same = " or ".join(" with ".join(f"`{name}`" for name in sorted(names)) for names in effect.identical_to)
        lines.append(f"- **States the same physics as:** {same}")
    excluded = {e.name for e in CATALOGUE if e.name in effect.excludes or effect.name in e.excludes}
    if excluded:
        lines.append(f"- **Not on one joint with:** {_listed(sorted(excluded))}")
    lines.append(f"- **Source:** {effect.source}")
    if effect.experiments:
        lines += ["", "| rival | experiment that tells them apart |", "|---|---|"]
        lines += [f"| `{rival}` | {effect.experiment(rival, 'the joint')} |" for rival in effect.experiments]
    return "\n".join([*lines, ""])


def parameters(effect: Effect) -> str:
    """Names with the units that a hinge and a slide give them."""
    hinge, slide = ({p.name: p.unit for p in _parameters(effect, model)} for model in (HINGE, SLIDE))
    units = {name: unit if slide.get(name, unit) == unit else f"{unit}; {slide[name]}" for name, unit in hinge.items()}
    return ", ".join(f"`{name}` [{unit}]" for name, unit in units.items())


def changes(effect: Effect) -> list[str]:
    """What the effect touches in a simulation: fields of ``mjModel``, the torque's way, laws, gears."""
    model, address, joint = _place(effect, HINGE)
    plant = Plant(model, address, 1)
    given = {name: value.copy() for name, value in vars(plant).items() if isinstance(value, np.ndarray)}
    steps = [p.scale if p.nominal + p.scale <= p.upper else -p.scale for p in _parameters(effect, HINGE)]
    effect.apply(plant, joint, np.array([[p.nominal for p in _parameters(effect, HINGE)]]) + steps)
    chain = [f"Plant.{name}" for name, value in given.items() if (getattr(plant, name) != value).any()]
    lists = [f"Plant.{name}" for name in ("motor", "laws", "gears") if getattr(plant, name)]
    return [*(f"mjModel.{name}" for name in plant.fields), *chain, *lists]


def _parameters(effect: Effect, model: mujoco.MjModel) -> tuple[Parameter, ...]:
    return effect.parameters(*_place(effect, model))


def _place(effect: Effect, model: mujoco.MjModel) -> tuple[mujoco.MjModel, JointAddress, int]:
    """A model of one joint, or a chain where a hinge alone cannot have the effect."""
    alone = model, JointAddress.of(model, ("joint",)), 0
    if model is not HINGE or effect.parameters(*alone):
        return alone
    return CHAIN, JointAddress.of(CHAIN, ("before", "joint")), 1


def _cell(text: str) -> str:
    return text.replace("|", "∣")  # a bar would end the cell


def _line(text: str) -> str:
    return " ".join(text.replace("``", "`").split())


def _listed(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
