"""Watching: the same simulation in sumo-gui over TraCI, with a picture of tracks, trains and links laid over the net.

Real tracks lie 4.5 m apart and trains kilometres: at a scale that shows a formation the net is one line. So the picture repeats
the tracks farther apart, with a dot for every train, coloured by its role, and an arc for every link: above for what a train
receives from ahead, below for what it receives from behind. It stands on the kilometrage, above the net; zoom in on it to see the
trains themselves, which have the same colours. A net of any shape (``Map``) has no such picture: dots and links lie on it.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import traci

from sumo_net import Line
from trainctl.errors import InputError, SimulatorError
from trainctl.signals import Floats, Ints, Links, Start
from trainctl.sumo.session import Sumo

#: First of a formation; any other member; a train that receives from none. The colour-blind can tell them apart, too.
FIRST, MEMBER, ALONE = (213, 94, 0, 255), (0, 114, 178, 255), (120, 120, 120, 255)
TRACK, LINK = (150, 150, 150, 255), (0, 158, 115, 255)

#: Corners of an arc.
CORNERS = 9

VIEW = """<viewsettings>
    <scheme name="trainctl">
        <background backgroundColor="white" showGrid="0"/>
        <vehicles vehicleMode="0" vehicleQuality="2" vehicle_exaggeration="1.00"/>
        <polys polySize="1.00" polyName_show="0" polyType_show="0"/>
        <pois poiSize_exaggeration="1.00" poiName_show="1" poiName_size="70.00" poiName_color="black" poiName_constantSize="1"/>
        <legend showSizeLegend="1"/>
    </scheme>
    <delay value="{delay_ms:g}"/>
</viewsettings>
"""


def program(name: str) -> str:
    """Path of ``sumo-gui`` (or ``sumo``): that of the eclipse-sumo wheel, else that of the PATH."""
    try:
        from sumo import SUMO_HOME
    except ImportError:
        SUMO_HOME = os.environ.get("SUMO_HOME", "")
    own = Path(SUMO_HOME) / "bin" / name
    found = str(own) if own.is_file() else shutil.which(name)
    if found is None:
        raise InputError(f"{name}: no such program; it comes with eclipse-sumo")
    return found


class Gui(Sumo):
    """A simulation over TraCI in ``binary``; with "sumo" everything is the same but for the window.

    Parameters
    ----------
    line, net, folder, step, steps, record_every
        As of ``Sumo``.
    binary : str
        Program to start.
    delay_ms : float
        Minimum time of a step on the screen.
    """

    api: Any = traci
    idle = False  # fast enough to be looked at, and SUMO's window would show its warnings

    def __init__(
        self, line: Line, net: Path, folder: Path, step: float, steps: int, record_every: float | None = None,
        binary: str = "sumo-gui", delay_ms: float = 20.0,
    ) -> None:  # fmt: skip
        super().__init__(line, net, folder, step, steps, record_every)
        self.binary, self.delay_ms = binary, delay_ms
        self.links: Links | None = None
        self.shown: set[str] = set()

    def start(self, start: Start) -> None:
        """As in ``Sumo``; then the picture."""
        self._scale(start)
        (self.folder / "view.xml").write_text(VIEW.format(delay_ms=self.delay_ms), encoding="utf-8")
        (self.folder / "picture.add.xml").write_text(self._tracks(), encoding="utf-8")
        super().start(start)
        self.colours, self.dots = [ALONE] * len(self.ids), set[int]()
        self._call(self._draw)
        if self.window:
            x, y = self._middle()
            traci.gui.setSchema(traci.gui.DEFAULT_VIEW, "trainctl")
            traci.gui.setBoundary(traci.gui.DEFAULT_VIEW, x - self.width / 2, y, x + self.width / 2, y)

    def _scale(self, start: Start) -> None:
        """Distance of the tracks of the picture, and width of what the window shows [m]."""
        seen = start.lane_position + self.line.start_m[start.edge]
        length = max(float(np.ptp(seen)), 2000.0)
        self.spread, self.width = 0.06 * length, 1.5 * length

    def _ready(self) -> None:
        if traci.isLoaded():
            raise SimulatorError("another simulation is being shown by this process already")

    def _launch(self, options: list[str]) -> None:
        """Start the program and connect; without a display it ends at once."""
        self.window = "gui" in Path(self.binary).name
        command = [program(self.binary), *options, "--additional-files", str(self.folder / "picture.add.xml")]
        if self.window:
            command += ["--gui-settings-file", str(self.folder / "view.xml"), "--start", "--quit-on-end"]
            command += ["--window-size", "1400,600", "--window-pos", "20,20"]
            if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                raise InputError("--gui: there is no display here; a finished run can be shown elsewhere: trainctl replay RUN")
        port = traci.getFreeSocketPort()
        silent = subprocess.DEVNULL  # what SUMO has to say is in its message log
        process = subprocess.Popen([*command, "--remote-port", str(port)], stdout=silent, stderr=silent)
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # TraCI prints every attempt to connect
                traci.init(port, proc=process)
        except (traci.TraCIException, traci.FatalTraCIError) as error:
            process.kill()
            raise SimulatorError(f"{self.binary} could not be started: {error}") from None

    def linked(self, links: Links, formation: Ints) -> None:
        """Colour the trains by role and draw the links."""
        self.links = links
        self._call(self._colour, links, formation)
        self._call(self._draw)

    def _colour(self, links: Links, formation: Ints) -> None:
        order = links.order
        leads = np.ones(len(order), bool)
        leads[1:] = formation[order[1:]] != formation[order[:-1]]
        first = np.empty(len(order), bool)
        first[order] = leads
        hears = np.diff(links.first) > 0
        self.colours = [ALONE if not hears[i] else FIRST if first[i] else MEMBER for i in range(len(order))]
        for i in self.dots:
            traci.vehicle.setColor(self.ids[i], self.colours[i])
            traci.polygon.setColor(f"dot_{self.ids[i]}", self.colours[i])
        for arc in self.shown:
            traci.polygon.remove(arc)
        self.shown = set()

    def move(self, displacement: Floats, step: float) -> None:
        """As in ``Sumo``; then the picture follows."""
        self._call(super().move, displacement, step)
        self._call(self._draw)

    def _call(self, function: Any, *arguments: Any, **more: Any) -> Any:
        """TraCI's own errors in the project's words."""
        try:
            return function(*arguments, **more)
        except traci.FatalTraCIError:
            raise SimulatorError(f"{self.binary} ended before the run did: was its window closed?") from None
        except traci.TraCIException as error:
            raise SimulatorError(f"SUMO: {error}") from None

    def close(self) -> None:
        """End the simulation, whether the window is still there or not."""
        try:
            super().close()
        except traci.FatalTraCIError:
            return

    def _draw(self) -> None:
        places = {i: self._place(i) for i in np.flatnonzero(self.seen.present).tolist()}
        for i in self.dots - set(places):
            traci.poi.remove(f"train_{self.ids[i]}")
            traci.polygon.remove(f"dot_{self.ids[i]}")
        for i, (x, y) in places.items():
            name = self.ids[i]
            if i in self.dots:
                traci.poi.setPosition(f"train_{name}", x, y + 0.3 * self.spread)
                traci.polygon.setShape(f"dot_{name}", self._dot(x, y))
            else:
                traci.poi.add(f"train_{name}", x, y + 0.3 * self.spread, color=ALONE, poiType="train", layer=300)
                traci.polygon.add(f"dot_{name}", self._dot(x, y), self.colours[i], fill=True, polygonType="train", layer=300)
                if self.links is not None:
                    traci.vehicle.setColor(name, self.colours[i])
        self.dots = set(places)
        if self.links is not None:
            for sender, receiver, heard in zip(*(x.tolist() for x in (self.links.sender, self.links.receiver, self.links.heard)),
                                               strict=True):  # fmt: skip
                if not {sender, receiver} <= self.dots:
                    continue
                self._arc(f"link_{self.ids[sender]}_{self.ids[receiver]}", places[sender], places[receiver], heard)
        if self.window:
            traci.gui.setOffset(traci.gui.DEFAULT_VIEW, *self._middle())

    def _arc(self, name: str, a: tuple[float, float], b: tuple[float, float], heard: bool) -> None:
        s = np.linspace(0.0, 1.0, CORNERS)
        # From ahead above, from behind below; longer links reach higher.
        rise = 2.0 * np.sign(a[0] - b[0]) * min(0.4 * self.spread, 0.06 * abs(a[0] - b[0])) * s * (1.0 - s)
        shape = list(zip((a[0] + s * (b[0] - a[0])).tolist(), (a[1] + s * (b[1] - a[1]) + 2.0 * rise).tolist(), strict=True))
        if name in self.shown:
            traci.polygon.setShape(name, shape)
        elif heard:
            traci.polygon.add(name, shape, LINK, fill=False, polygonType="link", layer=200, lineWidth=self.spread / 25)
            self.shown.add(name)

    def _place(self, i: int) -> tuple[float, float]:
        """Where a train is in the picture; on a crossover between its tracks."""
        seen = self.seen
        edge, x = int(seen.edge[i]), float(seen.position[i])
        over = next((c for c in self.line.crossovers if c.edge == self.line.edges[edge]), None)
        y = self._height(self.line.tracks[edge])
        if over is not None:
            s = (x - over.start_m) / over.length_m
            y = (1.0 - s) * self._height(over.from_track) + s * self._height(over.to_track)
        return x - self.line.begin_m, y

    def _dot(self, x: float, y: float) -> list[tuple[float, float]]:
        angle = np.linspace(0.0, 2.0 * np.pi, 17)
        corners = self.spread * 0.11 * np.column_stack((np.cos(angle), np.sin(angle))) + (x, y)
        return [(float(a), float(b)) for a, b in corners]

    def _height(self, track: str) -> float:
        return self.spread * (len(self.line.track_ids) - self.line.track_ids.index(track))

    def _middle(self) -> tuple[float, float]:
        x = self.seen.position - self.line.begin_m
        return float(x.min() + x.max()) / 2, self.spread * (len(self.line.track_ids) + 1) / 2

    def _tracks(self) -> str:
        """Tracks and crossovers as SUMO polygons."""
        line, width = self.line, self.spread / 60
        ways = [(f"track_{t}", 0.0, line.end_m - line.begin_m, t, t) for t in line.track_ids]
        ways += [
            (f"crossover_{c.id}", a := c.start_m - line.begin_m, a + c.length_m, c.from_track, c.to_track) for c in line.crossovers
        ]
        colour = ",".join(map(str, TRACK))
        rows = [
            f'    <poly id={quoteattr(name)} type="track" color="{colour}" fill="0" layer="100" lineWidth="{width:.2f}"'
            f' shape="{a:.2f},{self._height(t):.2f} {b:.2f},{self._height(u):.2f}"/>\n'
            for name, a, b, t, u in ways
        ]
        return "<additional>\n" + "".join(rows) + "</additional>\n"


class Map(Gui):
    """The same for a net of any shape: dots and links lie on the net itself, and trains come and go."""

    def _scale(self, start: Start) -> None:
        location = next(e for _, e in ElementTree.iterparse(self.net) if e.tag == "location")
        x0, y0, x1, y1 = (float(part) for part in location.get("convBoundary", "0,0,1000,1000").split(","))
        self.centre, self.width = ((x0 + x1) / 2, (y0 + y1) / 2), 1.1 * max(x1 - x0, y1 - y0, 1000.0)
        self.spread = 0.04 * self.width

    def _place(self, i: int) -> tuple[float, float]:
        x, y = traci.vehicle.getPosition(self.ids[i])
        return float(x), float(y)

    def _middle(self) -> tuple[float, float]:
        return self.centre

    def _tracks(self) -> str:
        """The net is there already."""
        return "<additional/>\n"
