"""One short run of SUMO's with cars, a bus that stops and a person who walks, in every log and format that there is."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

from sumo_net.build import program

ROUTES = """<routes>
<vType id="car" vClass="passenger"><param key="has.ssm.device" value="true"/></vType>
<vType id="bus" vClass="bus" maxSpeed="10"/>
<flow id="f" type="car" begin="0" end="60" number="12" from="A0B0" to="C1C2"/>
<trip id="b#1" type="bus" depart="3" from="A0B0" to="C1C2"><stop lane="B0C0_1" endPos="100" duration="20"/></trip>
<person id="p1" depart="5"><walk from="A0A1" to="A1B1"/><walk from="A1B1" to="B1C1"/></person>
</routes>"""
OUTPUTS = {
    "fcd": "fcd-output", "tripinfo": "tripinfo-output", "summary": "summary-output", "statistics": "statistic-output",
    "stops": "stop-output", "vehroute": "vehroute-output", "collisions": "collision-output", "emission": "emission-output",
    "personsummary": "person-summary-output", "ssm": "device.ssm.file", "persons": "personinfo-output",
    "walks": "personroute-output",
}  # fmt: skip
FORMS = {
    "xml": [], "human": ["-H"], "tag.csv": ["--output.column-header", "tag"], "plain.csv": ["--output.column-header", "plain"],
    "full.csv": ["--output.column-header", "full"], "comma.csv": ["--output.column-separator", ","],
    "bar.csv": ["--output.column-separator", "|"], "parquet": [],
}  # fmt: skip
KINDS = (*OUTPUTS, "edgedata", "lanedata")
#: Cars nearer to each other than three gaps collide, and nobody minds: the log of collisions is not empty.
COLLIDING = ("--collision.action", "warn", "--collision.mingap-factor", "3")
#: SUMO 1.28 dies of these in Parquet.
NO_PARQUET = ("ssm", "persons", "walks")


def write(place: Path, forms: Iterable[str]) -> None:
    """A folder of logs for each of these forms."""
    (place / "r.rou.xml").write_text(ROUTES)
    run = {"cwd": place, "capture_output": True, "check": True}
    netgenerate, environment = program("netgenerate")
    grid = ["--grid", "--grid.number", "3", "--grid.length", "150", "--sidewalks.guess", "-o", "g.net.xml"]
    subprocess.run([netgenerate, *grid], env=environment, **run)
    for form in forms:
        (place / form).mkdir()
        ending = form.rpartition(".")[2].replace("human", "xml")
        data = "".join(f'<{k}Data id="d" file="{form}/{k}data.{ending}" freq="50"/>' for k in ("edge", "lane"))
        (place / f"{form}.add.xml").write_text(f"<additional>{data}</additional>")
        endings = dict.fromkeys(OUTPUTS, ending) | (dict.fromkeys(NO_PARQUET, "xml") if ending == "parquet" else {})
        outputs = [f"--{key}={form}/{name}.{endings[name]}" for name, key in OUTPUTS.items()]
        command = ["-n", "g.net.xml", "-r", "r.rou.xml", "-a", f"{form}.add.xml", "-e", "450", "--no-step-log", "--no-warnings",
                   "--vehroute-output.exit-times", *COLLIDING, *outputs, *FORMS[form]]  # fmt: skip
        subprocess.run([program("sumo")[0], *command], env=environment, **run)
