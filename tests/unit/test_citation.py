"""What to cite: complete, the same in CITATION.cff, and a command for a run."""

from __future__ import annotations

import json
import re
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

from trainctl import citation
from trainctl.laws import laws

CFF = Path(__file__).parents[2] / "CITATION.cff"


@pytest.fixture(scope="module")
def cff():
    return yaml.safe_load(CFF.read_text(encoding="utf-8"))


def test_every_law_of_a_paper_has_one():
    assert {*citation.PAPERS, *citation.STANDARDS} == {law for law in laws() if law != "sumo"}
    assert not set(citation.PAPERS) & set(citation.STANDARDS)


def test_the_file_for_citation_names_the_same(cff):
    works = [*citation.PAPERS.values(), *citation.STANDARDS.values(), *citation.OBSERVER_PAPERS.values(), citation.SUMO]
    assert [r["title"] for r in cff["references"]] == [w.title for w in works]
    for reference, work in zip(cff["references"], works, strict=True):
        authors = [" ".join(filter(None, (a.get("given-names"), a["family-names"]))) for a in reference["authors"]]
        assert authors == list(work.authors)
        assert reference.get("year") == work.year
        assert reference.get("doi", "") == work.doi
    assert cff["title"] == citation.TRAINCTL_TITLE
    assert cff["authors"] == [{"name": citation.TRAINCTL_AUTHORS}]
    assert cff["date-released"].year == citation.TRAINCTL_YEAR
    assert cff["version"] == version("trainctl")


def entries(text):
    """BibTeX entries: key -> fields; every brace is closed."""
    assert text.count("{") == text.count("}")
    found = {}
    for key, body in re.findall(r"^@\w+\{(\w+),\n(.*?)\n\}$", text, re.S | re.M):
        found[key] = dict(re.findall(r"^  (\w+) = \{(.*)\},$", body, re.M))
    return found


def test_an_ampersand_does_not_part_columns_in_latex():
    (fields,) = entries(citation.PAPERS["emu_finite_time"].bibtex()).values()
    assert fields["journal"] == r"Control Theory \& Applications"
    assert "Control Theory & Applications" in citation.PAPERS["emu_finite_time"].text()


def test_entries_have_what_their_kind_needs():
    for work in [
        *citation.PAPERS.values(),
        *citation.STANDARDS.values(),
        *citation.OBSERVER_PAPERS.values(),
        citation.SUMO,
        citation.trainctl("1.2"),
    ]:
        (fields,) = entries(work.bibtex()).values()
        needed = {
            "article": "journal",
            "inproceedings": "booktitle",
            "unpublished": "note",
            "misc": "howpublished",
            "software": "version",
        }
        assert {"author", "title", needed[work.kind]} <= set(fields)
        assert all(fields.values())
        assert fields["title"] == f"{{{work.title}}}"
    assert entries(citation.trainctl("1.2").bibtex())["trainctl"]["author"] == "{The trainctl authors}"  # one name, not three
    assert citation.PAPERS["fully_distributed"].text().endswith("Approach. Manuscript without a date.")


@pytest.mark.parametrize(
    ("law", "observer", "in_sumo", "keys", "words"),
    [
        ("robust_constrained", "none", True, ["trainctl", "hu_robust_2024", "lopez_sumo_2018"], ["SUMO was 1.28.0"]),
        (
            "fault_tolerant",
            "intermediate",
            False,
            ["trainctl", "zhang_fault_tolerant_2022", "zhu_intermediate_2015"],
            ["did not run"],
        ),
        ("sumo", "none", True, ["trainctl", "lopez_sumo_2018"], ["no paper of a law", "SUMO was"]),
        ("my_law.py", "none", True, ["trainctl", "lopez_sumo_2018"], ["law my_law.py: not of a paper", "SUMO was"]),
    ],
)
def test_what_a_run_rests_on(law, observer, in_sumo, keys, words):
    found, remarks = citation.works(law, observer, {"trainctl": "0.1.0", "sumo": "1.28.0"}, in_sumo)
    assert [w.key for w in found] == keys
    assert len(remarks) == len(words)
    for remark, word in zip(remarks, words, strict=True):
        assert word in remark


def test_command_prints_text_and_entries(tmp_path, monkeypatch, capsys):
    from trainctl.cli import program

    def typed(*words):
        monkeypatch.setattr("sys.argv", ["trainctl", *words])
        with pytest.raises(SystemExit) as end:
            program.main()
        return end.value.code or 0, *capsys.readouterr()

    folder = tmp_path / "run"
    folder.mkdir()
    info = {"format": "trainctl run", "schema_version": 1, "versions": {"trainctl": "0.0.9", "sumo": "1.28.0"}, "backend": "sumo"}
    (folder / "run.json").write_text(json.dumps(info))
    (folder / "scenario.toml").write_text('[controller]\nlaw = "robust_constrained"\n')
    code, out, _ = typed("cite", str(folder))
    assert code == 0
    assert "Version 0.0.9." in out  # the one that ran
    assert "Qijie Hu, Xinyu Fan, Yue Wei (2024): Robust Constrained Cooperative Control" in out
    assert "https://doi.org/10.3390/math12132003" in out
    assert list(entries(out)) == ["trainctl", "hu_robust_2024", "lopez_sumo_2018"]
    code, out, _ = typed("cite", str(folder), "--json")
    told = json.loads(out)
    assert [work["key"] for work in told["works"]] == ["trainctl", "hu_robust_2024", "lopez_sumo_2018"]
    assert entries(told["works"][1]["bibtex"])["hu_robust_2024"]["doi"] == "10.3390/math12132003"
    code, _, err = typed("cite", str(tmp_path))
    assert (code, "not a run folder" in err) == (2, True)
