"""The page: sections with pictures and tables, written as one HTML file that needs nothing else."""
import base64
import csv
import dataclasses
import datetime
import html
import json
import os
import pathlib
import platform
import subprocess

ROOT = pathlib.Path(__file__).resolve().parents[2]

# What a verdict may be, and its colour.
VERDICTS = {"holds": "#1e8449", "holds in part": "#b9770e", "does not hold": "#c0392b", "not shown yet": "#777777"}


@dataclasses.dataclass
class Picture:
    file: str  # name of the PNG beside the page
    caption: str
    draw: object  # called with the path; writes nothing where there is nothing to show


@dataclasses.dataclass
class Table:
    file: str  # name of the CSV beside the page, or None
    header: list
    rows: list
    caption: str = ""
    shown: int = 40  # more rows than that are in the CSV only
    docs: bool = False  # also in docs/report.md, with its CSV


@dataclasses.dataclass
class Section:
    """One figure of the paper, or anything else that is claimed and measured. Texts are HTML."""

    anchor: str
    title: str
    paper: str  # what the paper shows
    measured: str  # what we measure
    reference: str  # against what
    verdict: tuple  # (one of VERDICTS, why)
    pictures: list = dataclasses.field(default_factory=list)
    tables: list = dataclasses.field(default_factory=list)
    data: list = dataclasses.field(default_factory=list)  # names of CSV files beside the page that docs keep too
    missing: list = dataclasses.field(default_factory=list)  # cases that it would show and that are not there


def number(value, digits=3):
    if value is None or (isinstance(value, float) and value != value):
        return "\u2013"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def percent(value):
    return "\u2013" if value is None or value != value else f"{100 * value:+.1f} %"


STYLE = """
body { font: 15px/1.45 "DejaVu Sans", Verdana, sans-serif; color: #222; max-width: 62rem; margin: 1.5rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.3rem; margin-top: 2.5rem; border-bottom: 2px solid #222; }
h3 { font-size: 1.08rem; margin: 2rem 0 .4rem; } h4 { font-size: .95rem; margin: .8rem 0 .2rem; }
figure { margin: .8rem 0; } figure img { max-width: 100%; height: auto; } figcaption, caption { font-size: .85rem; color: #555; text-align: left; }
table { border-collapse: collapse; font-size: .82rem; margin: .6rem 0; } th, td { border-bottom: 1px solid #ddd; padding: .15rem .6rem .15rem 0; text-align: right; }
th:first-child, td:first-child, th.text, td.text { text-align: left; } td:first-child { white-space: nowrap; } .wide { overflow-x: auto; } dl { margin: .4rem 0; } dt { font-weight: bold; font-size: .85rem; color: #555; } dd { margin: 0 0 .4rem 0; }
.verdict { border-left: .4rem solid; padding: .2rem .7rem; background: #f6f6f6; } .missing { color: #777; font-size: .85rem; } code { font-size: .9em; }
"""


PROSE = 60  # characters: a cell with more is a sentence


def embedded(path):
    return "data:image/png;base64," + base64.b64encode(pathlib.Path(path).read_bytes()).decode()


def write_table(table, folder):
    if table.file:
        with open(folder / table.file, "w", newline="") as f:
            writer = csv.writer(f)
            writer.writerow(table.header)
            for row in table.rows:
                writer.writerow(["" if v is None else f"{v:.9g}" if isinstance(v, float) else v for v in row])
    if len(table.rows) > table.shown:
        return f'<p class="missing">{html.escape(table.caption)} {len(table.rows)} rows: {table.file}</p>'
    # Columns of sentences begin at the left, of numbers and short words at the right.
    prose = [' class="text"' if any(len(str(row[k])) > PROSE for row in table.rows) else "" for k in range(len(table.header))]
    cells = ["".join(f"<th{c}>{html.escape(str(h))}</th>" for c, h in zip(prose, table.header))]
    cells += ["".join(f"<td{c}>{html.escape(number(v))}</td>" for c, v in zip(prose, row)) for row in table.rows]
    return (f'<div class="wide"><table><caption>{html.escape(table.caption)}'
            f'{f" ({table.file})" if table.file else ""}</caption>'
            + "".join(f"<tr>{c}</tr>" for c in cells) + "</table></div>")  # fmt: skip


def markdown(table, place):
    """The table as lines of Markdown, and where its CSV is."""

    def cell(value):
        return html.unescape(number(value)).replace("|", "\\|").replace("\n", " ")

    lines = ["", f"{table.caption}" + (f" ([CSV]({place}/{table.file}))" if table.file else ""), ""]
    lines += ["| " + " | ".join(map(cell, table.header)) + " |", "|" + "---|" * len(table.header)]
    return lines + ["| " + " | ".join(map(cell, row)) + " |" for row in table.rows]


def write_section(section, folder):
    word, why = section.verdict
    out = [f'<section id="{section.anchor}"><h3>{html.escape(section.title)}</h3>']
    for picture in section.pictures:
        (folder / picture.file).unlink(missing_ok=True)
        picture.draw(folder / picture.file)
        if not (folder / picture.file).exists():
            continue
        out.append(f'<figure><img alt="{html.escape(picture.caption)}" src="{embedded(folder / picture.file)}">'
                   f"<figcaption>{picture.caption}</figcaption></figure>")  # fmt: skip
    out.append(f"<dl><dt>The paper shows</dt><dd>{section.paper}</dd><dt>We measure</dt><dd>{section.measured}</dd></dl>")
    out += [write_table(t, folder) for t in section.tables]
    out.append(f"<dl><dt>Against</dt><dd>{section.reference}</dd></dl>")
    out.append(f'<p class="verdict" style="border-color:{VERDICTS[word]}"><b>Verdict: {word}.</b> {why}</p>')
    if section.missing:
        out.append(f'<p class="missing">Not run yet: {", ".join(section.missing)}.</p>')
    out.append("</section>")
    return "\n".join(out)


def commit():
    try:
        return subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True,
                              check=True).stdout.strip()  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def studied(folder):
    """What the studies were run with: the first digits of the digest that study.Store keeps, or nothing."""
    file = pathlib.Path(folder) / "points.jsonl"
    if not file.exists():
        return ""
    with file.open() as f:
        first = json.loads(f.readline())
    return f"studies of one program, SHA-256 {first[1][:12]}" if first[0] == "runner" else ""


def write_docs(parts, shelf, folder, size, docs):
    """Writes docs/report.md (of the size paper; report-SIZE.md of another), and copies the pictures into docs/report/SIZE.
    Of what write() has drawn."""
    kept = docs / "report" / size
    kept.mkdir(parents=True, exist_ok=True)
    for old in [*kept.glob("*.png"), *kept.glob("*.csv")]:
        old.unlink()
    there = [r for r in (shelf.get(c.name) for c in shelf.cases) if r]
    out = ["# The paper's figures with our numbers", "",
           f"Written by `make report-docs SIZE={size}` from what `make report SIZE={size}` has run: "
           f"{len(there)} of {len(shelf.cases)} runs{'; ' if studied(folder) else ''}{studied(folder)}. `make report` writes the whole page, with every table "
           "(`build/report/SIZE/report.html`). *standard* is without F\u0304, *zhao* is Algorithm 1 of the paper, *anchored* is our "
           "scheme (method.md). " + ("What is not run yet at full size is shown by the [small size](report-small.md). " if size == "paper" else
                                     "The paper's sizes are in [report.md](report.md). ") + "Figures are of Zhao, Jiang and Choo; theirs are not copied here.", "",
           "| figure | verdict |", "|---|---|"]  # fmt: skip
    out += [f"| [{s.title}](#{s.anchor}) | {s.verdict[0]} |" for _, sections in parts for s in sections]
    for title, sections in parts:
        out += ["", f"## {title}"]
        if not sections:
            out += ["", f"Not run at this size yet; [report-small.md](report-small.md#{title.lower().replace(' ', '-')}) has it." if size == "paper"
                    else "Not run yet."]  # fmt: skip
        for s in sections:
            out += ["", f'<a id="{s.anchor}"></a>', f"### {s.title}", ""]
            for picture in s.pictures:
                if (folder / picture.file).exists():
                    (kept / picture.file).write_bytes((folder / picture.file).read_bytes())
                    out += [f"![{picture.caption}](report/{size}/{picture.file})", "", f"*{picture.caption}*", ""]
            out += [f"The paper: {s.paper}", "", f"Measured: {s.measured}", "", f"Against: {s.reference}", "",
                    f"**Verdict: {s.verdict[0]}.** {s.verdict[1]}"]  # fmt: skip
            for table in s.tables:
                if table.docs:
                    out += markdown(table, f"report/{size}")
                    if table.file:
                        (kept / table.file).write_bytes((folder / table.file).read_bytes())
            for name in s.data:
                if (folder / name).exists():
                    (kept / name).write_bytes((folder / name).read_bytes())
            out += ["", f"Not run yet: {', '.join(s.missing)}."] if s.missing else []
    path = docs / ("report.md" if size == "paper" else f"report-{size}.md")
    path.write_text("\n".join(out) + "\n", encoding="utf-8")
    return path


def write(parts, shelf, folder, size):
    """Writes report.html, its pictures and its tables into `folder`. parts: (title, [Section]). Gives its path."""
    folder = pathlib.Path(folder)
    body, contents = [], []
    for title, sections in parts:
        body.append(f"<h2>{html.escape(title)}</h2>")
        for section in sections:
            contents.append(
                f'<tr><td><a href="#{section.anchor}">{html.escape(section.title)}</a></td>'
                f'<td style="color:{VERDICTS[section.verdict[0]]}">{section.verdict[0]}</td></tr>'
            )
            body.append(write_section(section, folder))
    there = [r for r in (shelf.get(c.name) for c in shelf.cases) if r]
    runs = Table("runs.csv", ["run", "state", "particles", "steps", "end (s)", "max |ln(J/J\u0304)|", "M particle-steps/s"],
                 [[r.name, r.state, r.particles, r.steps, float(r.times[-1]),
                   r.run.get("probes", {}).get("drift"), r.speed()] for r in there],
                 "All runs of this page. Speeds are of the moment, beside other runs, and no benchmark.", shown=200)  # fmt: skip
    missing = shelf.missing()
    versions = sorted({r.version for r in there})
    text = f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>fbard: the paper's figures, size {size}</title><style>{STYLE}</style></head><body>
<h1>The paper's figures with our numbers</h1>
<p>Figures 3 to 6, 8 to 10, 12 and 14 to 16 of Zhao, Jiang and Choo, <i>Circumventing volumetric locking in explicit
material point methods</i>, as fbard computes them. Written by <code>make report SIZE={size}</code> on
{datetime.date.today().isoformat()}, {os.cpu_count()} cores, {platform.machine()}; page of commit {commit()}, runs of
fbard {", ".join(versions) or "-"}; {len(there)} of {len(shelf.cases)} runs are there; {studied(folder) or "no studies"}. The pictures and the numbers
behind them lie beside this file as PNG and CSV.</p>
<p>Words: <b>standard</b> is without F\u0304; <b>zhao</b> is Algorithm 1 of the paper; <b>anchored</b> is our F\u0304 scheme, which has
a limit at rest (docs/method.md). Stress is positive in tension. The paper's figures are quoted, not copied; where it
compares with B\u0304 or three-field results that are not at hand, finite elements and exact solutions stand in.</p>
<table><tr><th>figure</th><th>verdict</th></tr>{"".join(contents)}</table>
{chr(10).join(body)}
<h2>Runs</h2>
{write_table(runs, folder)}
<p class="missing">{"Not run yet: " + ", ".join(missing) + "." if missing else "All runs are there."}</p>
</body></html>
"""
    path = folder / "report.html"
    scratch = folder / "report.html.new"
    scratch.write_text(text, encoding="utf-8")
    scratch.replace(path)
    return path
