"""What can go wrong, by whose fault it is; the command line turns each into its exit code: 2 bad input, 3 the run failed."""

from __future__ import annotations

from collections.abc import Sequence


def printable(line: str) -> str:
    """One line that a terminal shows as it is: what a file may say is escaped."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)


#: Control characters but tab and newline, and those that turn the direction of writing; and how they are shown.
STEERING = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\t\n"}
STEERING |= {code: f"\\u{code:04x}" for code in (0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))}


def visible(text: str) -> str:
    """Text as it is written: characters that steer a terminal, which titles and ids may hold, are shown as hexadecimal escapes."""
    return text.translate(STEERING)


#: Packages a light install leaves out (tools/light.txt), and what needs them.
LEFT_OUT = {
    "libsumo": "SUMO", "sumo": "SUMO", "traci": "SUMO", "sumolib": "SUMO", "matplotlib": "figures", "plotly": "pages",
    "dask": "sweeps", "distributed": "sweeps",
}  # fmt: skip


def left_out(module: str) -> str:
    """What is to be said where a module is missing that a light install leaves out; "" for any other."""
    package = module.partition(".")[0]
    if package not in LEFT_OUT:
        return ""
    return f"{LEFT_OUT[package]}: {package} is not installed; `pip install trainctl` has it, this light install does not"


class TrainctlError(Exception):
    """Base of all errors this package raises on purpose."""

    exit_code = 3


class InputError(TrainctlError):
    """The user's input is wrong. Carries every mistake found, one line each: ``file: key = value: rule``."""

    exit_code = 2

    def __init__(self, mistakes: Sequence[str] | str) -> None:
        self.mistakes = [printable(line) for line in ([mistakes] if isinstance(mistakes, str) else mistakes)]
        super().__init__("\n".join(self.mistakes))


class SimulatorError(TrainctlError):
    """SUMO stopped, or refused a command."""


class CouplingError(TrainctlError):
    """Something else than the plant moved a train: names train, edge, time and the likely cause."""


class LawError(TrainctlError):
    """A law or a plant gave a number that is not finite: names train and time."""
