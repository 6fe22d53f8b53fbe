"""The comparison with the papers as text, as JSON, and as one CSV row a number."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from .comparing import MET, VERDICTS, Exhibit, NumberTable, Paper


def headline(paper: Paper) -> str:
    """Return how many numbers and statements got which verdict."""
    counted = paper.count()
    return ", ".join(f"{counted[verdict]} {verdict}" for verdict in VERDICTS if counted[verdict])


def report(papers: Sequence[Paper]) -> str:
    """Return the report: what of each table and figure is met, by how much the rest differs, and why."""
    blocks = []
    for paper in papers:
        blocks.append(f"{paper.short}: {paper.title}\n{headline(paper)}")
        blocks += [_exhibit_text(exhibit) for exhibit in paper.exhibits]
    return "\n\n".join(blocks)


def _exhibit_text(exhibit: Exhibit) -> str:
    lines = [f"  {exhibit.title}"]
    for table in exhibit.tables:
        lines.append(f"    {summary(table)}")
    for one in exhibit.statements:
        lines.append(f"    {one.what}: {one.verdict}")
        lines += [f"      paper  {one.printed}", f"      found  {one.computed}"]
        lines += [f"      why    {one.why}"] * bool(one.why)
    return "\n".join(lines)


def summary(table: NumberTable) -> str:
    """Return title, how many numbers are met, what is said of the others, and the largest differences."""
    met = table.verdicts == MET
    others = ", ".join(sorted(set(table.verdicts[~met].tolist())))
    rest = f", the others: {others}" if others else ""
    largest = ", ".join(f"{value:.3g} {unit}" for unit, value in table.largest_differences().items())
    return f"{table.title}: {met.sum()} of {met.size} met{rest}; largest difference {largest}"


def difference_text(table: NumberTable, row: int, column: int) -> str:
    """Return computed minus printed in the column's unit of difference, with its sign."""
    value = float(table.differences[row, column]) * table.columns[column].factor
    return f"{value:+.4f}" if abs(value) >= 5e-5 or value == 0.0 else f"{value:+.0e}"


def records(papers: Sequence[Paper]) -> Iterator[dict[str, Any]]:
    """Yield one record for each printed number and statement."""
    for paper in papers:
        for exhibit in paper.exhibits:
            for table in exhibit.tables:
                for r, name in enumerate(table.rows):
                    for c, column in enumerate(table.columns):
                        yield {
                            "paper": paper.short,
                            "where": table.title,
                            "what": f"{column.name}, row {name}",
                            "unit": column.unit,
                            "printed": table.printed[r][c],
                            "computed": f"{table.computed[r, c]:.12g}",
                            "difference": f"{table.differences[r, c]:.6g}",
                            "verdict": table.verdicts[r, c],
                            "why": "",
                        }
            for one in exhibit.statements:
                place = {"paper": paper.short, "where": exhibit.title, "what": one.what, "unit": ""}
                numbers = {"printed": one.printed, "computed": one.computed, "difference": ""}
                yield {**place, **numbers, "verdict": one.verdict, "why": one.why}


def as_json(papers: Sequence[Paper]) -> dict[str, Any]:
    """Return the comparison for programs: counts of verdicts, and each number with its unit beside it."""
    counts = [{"paper": paper.short, "title": paper.title, **paper.count()} for paper in papers]
    return {"papers": counts, "numbers": list(records(papers))}
