"""The page of maps that last, docs/results_lifelong.md."""

from typing import Any

from training.report.page import Column, interval, number, table
from training.report.page import page as whole

_COLUMNS = (
    Column("ate_m", "Error, m", number),
    Column("joint_ate_m", "Error of all as one, m", number),
    Column("met", "Met at the end, %", number, 100.0),
    Column("in_time", "Met in time, %", number, 100.0),
    Column("scans_to_meeting", "Scans to meeting", number),
    Column("false_meetings", "False meetings, %", number, 100.0),
    Column("ms_a_step", "Computing time of a step, ms", number),
)

_INTRODUCTION = """# Results: several robots on one map

Made by `{command}`.

{settings[robots]} robots drive through each building at the same time, with {settings[scans]} scans of 360 rays each,
ten a second. There are {settings[buildings]} buildings as drawn, and {settings[aliased]} whose rooms look alike
(`aliased`), of the {settings[split]} split. These are few, so intervals of 95 %, by resampling buildings, are wide.

- `alone`: each robot has an `ngo_node` of its own. `together`: one for all, as with `robots` of `ngo_node`.
- Error: the root mean square distance of positions, each robot's trajectory aligned by itself, in the mean over robots;
  as one: of all robots that are in the common map, aligned together.
- Met in time: within 100 scans after two robots had 10 m of their way in common, a metre apart at most; scans from then
  on, where they met.
- False meetings: buildings in which a robot ever was more than 2 m from where the common map had it."""

_RATIO = "Error together over error alone, in the mean over buildings: {together}, and {aliased} in aliased ones."


def page(result: dict[str, Any]) -> str:
    """The page of a JSON's content."""
    paired = result["paired"]
    ratio = _RATIO.format(
        together=interval(paired["together"]["ate_ratio"]), aliased=interval(paired["aliased_together"]["ate_ratio"])
    )
    rows = {f"`{row}`": numbers for row, numbers in result["tables"]["fleet"].items()}
    return whole([_INTRODUCTION.format(**result), table(rows, _COLUMNS, "Row"), ratio])
