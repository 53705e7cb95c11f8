"""What to cite: trainctl, the papers of the laws, SUMO. As text and as BibTeX."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Work(NamedTuple):
    """Something to cite. Fields that are not known are left empty."""

    key: str  # of BibTeX
    kind: str  # of BibTeX
    authors: tuple[str, ...]  # "Given Family", given names only where they are known
    title: str
    year: int | None
    place: str  # journal, proceedings, archive
    details: Mapping[str, str]  # further fields of BibTeX: volume, number, pages, note, ...
    doi: str = ""

    def text(self) -> str:
        """One line to read."""
        where = [self.place, *(f"{_LABELS.get(name, '')}{value}" for name, value in self.details.items())]
        when = f" ({self.year})" if self.year else ""
        end = f". https://doi.org/{self.doi}" if self.doi else "."
        return f"{', '.join(self.authors)}{when}: {self.title}. {', '.join(filter(None, where))}{end}"

    def bibtex(self) -> str:
        """An entry."""
        fields = {"author": " and ".join(f"{{{a}}}" if a == TRAINCTL_AUTHORS else a for a in self.authors)}
        fields["title"] = f"{{{self.title}}}"
        if self.place:
            fields[_PLACE.get(self.kind, "howpublished")] = self.place
        fields |= {**self.details, "year": str(self.year or ""), "doi": self.doi}
        written = {name: value if name == "doi" else value.replace("&", r"\&") for name, value in fields.items()}  # & parts columns
        lines = [f"  {name} = {{{value}}}," for name, value in written.items() if value]
        return "\n".join([f"@{self.kind}{{{self.key},", *lines, "}"])

    def plain(self) -> dict[str, Any]:
        """For machines."""
        return {**self._asdict(), "details": dict(self.details), "text": self.text(), "bibtex": self.bibtex()}


_PLACE = {"article": "journal", "inproceedings": "booktitle", "software": "publisher"}
_LABELS = {"volume": "vol. ", "number": "no. ", "pages": "pp. ", "version": "Version "}

TRAINCTL_AUTHORS = "The trainctl authors"
TRAINCTL_TITLE = "trainctl: a closed-loop testbed for cooperative train control on rail networks"
TRAINCTL_YEAR = 2026

#: Papers of the laws: name of the law -> the paper.
PAPERS = {
    "fully_distributed": Work(
        "zhang_fully_distributed", "unpublished", ("Zhixin Zhang", "Zhiyong Chen", "Wentuo Fang"),
        "Cooperative Control of Constrained Discrete-Time Multi-Train Systems: A Fully Distributed Approach", None, "",
        {"note": "Manuscript without a date"},
    ),
    "emu_finite_time": Work(
        "wei_emu_2022", "article", ("Wei", "Ge", "Wu"),
        "Finite-time distributed cooperative cruise control of EMU groups", 2022, "Control Theory & Applications",
        {"number": "5", "note": "in Chinese"},
    ),
    "robust_constrained": Work(
        "hu_robust_2024", "article", ("Qijie Hu", "Xinyu Fan", "Yue Wei"),
        "Robust Constrained Cooperative Control for Multiple Trains", 2024, "Mathematics",
        {"volume": "12", "number": "13", "pages": "2003"}, "10.3390/math12132003",
    ),
    "fault_tolerant": Work(
        "zhang_fault_tolerant_2022", "misc", ("Zhixin Zhang", "Zhiyong Chen"),
        "Asymptotical Cooperative Cruise Fault Tolerant Control for Multiple High-speed Trains with State Constraints", 2022,
        "arXiv:2211.02242", {}, "10.48550/arXiv.2211.02242",
    ),
}  # fmt: skip

#: What the standards of the field follow, laws without claims of their own here: name of the law -> the description.
STANDARDS = {
    "time_headway": Work(
        "darbha_v2v_2018", "misc", ("Swaroop Darbha", "Shyamprasad Konduri", "Prabhakar R. Pagilla"),
        "Benefits of V2V Communication for Autonomous and Connected Vehicles", 2018, "arXiv:1803.02900", {},
        "10.48550/arXiv.1803.02900",
    ),
    "relative_braking": Work(
        "quaglietta_multi_state_2020", "article", ("Egidio Quaglietta", "Meng Wang", "Rob M. P. Goverde"),
        "A multi-state train-following model for the analysis of virtual coupling railway operations", 2020,
        "Journal of Rail Transport Planning & Management", {"volume": "15", "pages": "100195"}, "10.1016/j.jrtpm.2020.100195",
    ),
    "sliding_mode": Work(
        "swaroop_string_1996", "article", ("D. Swaroop", "J. K. Hedrick"),
        "String stability of interconnected systems", 1996, "IEEE Transactions on Automatic Control",
        {"volume": "41", "number": "3", "pages": "349-357"},
    ),
    "model_predictive": Work(
        "liu_distributed_2022", "article", ("Yafei Liu", "Ronghui Liu", "Chongfeng Wei", "Jing Xun", "Tao Tang"),
        "Distributed Model Predictive Control Strategy for Constrained High-Speed Virtually Coupled Train Set", 2022,
        "IEEE Transactions on Vehicular Technology", {"volume": "71", "number": "1", "pages": "171-183"},
    ),
}  # fmt: skip

#: Papers of observers that are not of the law's own paper: name of the observer -> the paper.
OBSERVER_PAPERS = {
    "intermediate": Work(
        "zhu_intermediate_2015", "article", ("J. W. Zhu", "G. H. Yang", "H. Wang", "F. Wang"),
        "Fault estimation for a class of nonlinear systems based on intermediate estimator", 2015,
        "IEEE Transactions on Automatic Control", {"volume": "61", "number": "9", "pages": "2518-2524"},
    ),
}  # fmt: skip

SUMO = Work(
    "lopez_sumo_2018", "inproceedings",
    (
        "Pablo Alvarez Lopez", "Michael Behrisch", "Laura Bieker-Walz", "Jakob Erdmann", "Yun-Pang Flötteröd", "Robert Hilbrich",
        "Leonhard Lücken", "Johannes Rummel", "Peter Wagner", "Evamarie Wießner",
    ),
    "Microscopic Traffic Simulation using SUMO", 2018, "21st International Conference on Intelligent Transportation Systems (ITSC)",
    {}, "10.1109/ITSC.2018.8569938",
)  # fmt: skip


def trainctl(version: str) -> Work:
    """Of trainctl in this version."""
    return Work(
        "trainctl", "software", (TRAINCTL_AUTHORS,), TRAINCTL_TITLE, TRAINCTL_YEAR, "", {"version": version} if version else {}
    )


def works(law: str, observer: str, versions: Mapping[str, str], in_sumo: bool) -> tuple[list[Work], list[str]]:
    """What a run rests on, and remarks in words.

    Parameters
    ----------
    law, observer : str
        Names in the scenario.
    versions : mapping
        Versions of ``trainctl`` and ``sumo`` that ran.
    in_sumo : bool
        Whether SUMO ran, or the loop without a simulator.
    """
    found, remarks = [trainctl(versions.get("trainctl", ""))], []
    if law in PAPERS or law in STANDARDS:
        found.append({**PAPERS, **STANDARDS}[law])
    elif law == "sumo":
        remarks.append("the trains were driven by SUMO's own models: no paper of a law")
    else:
        remarks.append(f"law {law}: not of a paper that trainctl knows; cite where it comes from")
    if observer in OBSERVER_PAPERS:
        found.append(OBSERVER_PAPERS[observer])
    if in_sumo:
        found.append(SUMO)
        remarks.append(f"SUMO was {versions.get('sumo', 'of an unknown version')}")
    else:
        remarks.append("SUMO did not run: the loop was closed without a simulator")
    return found, remarks
