"""What the answers of a report rest on: runs, policies, paths, contributions, the landscape; how it was computed."""

import numpy as np

from perfcontrol._printing import number as short
from perfcontrol.plotting.certificate import contributions_of
from perfcontrol.reports.page.figures import Gallery, legend
from perfcontrol.reports.page.findings import STEPS, Findings
from perfcontrol.reports.page.markup import (
    Html,
    bullets,
    figures,
    joined,
    missing,
    number,
    paragraph,
    subheading,
    table,
)
from perfcontrol.results import versions
from perfcontrol.solvers import Result
from perfcontrol.theory import Sharp


def convergence(found: Findings, gallery: Gallery) -> Html:
    """Iterates of the runs, and how each ended."""
    body = joined(missing(reason) for part, reason in found.why_not.items() if part.startswith("convergence"))
    if not found.convergence:
        return Html(body or missing("No run was made."))
    rows = []
    for name, run in found.convergence.items():
        residual = run.stats.get("residual")
        rows.append([name, Result[run.result], int(run.steps), "–" if residual is None else number(float(residual), 2)])
    measured = "stable" in found.policies or any(run.result == Result.success for run in found.convergence.values())
    if not measured:
        body += missing("No stable policy is known and no run succeeded: there is nothing to measure distances from.")
    else:
        caption = "Each line: how far the iterates of a run are from the stable policy. A cross: where a run failed."
        body += figures(gallery.convergence(), caption)
    return Html(body + table("The runs", ["Run", "How it ended", "Steps", "Residual"], rows))


def policies(found: Findings, gallery: Gallery) -> Html:
    """Heat maps."""
    if not found.policies:
        return missing("No policy is known.")
    body = paragraph(
        "Row j, column k of lag i: what the disturbance of state k, i steps ago, adds to input j. Blue is positive, "
        "orange negative, on one scale for all."
    )
    norms = [f"‖M‖_F is {np.linalg.norm(M):.4g} for {name}" for name, M in found.policies.items()]
    return Html(body + figures(gallery.policies(), f"{'; '.join(norms)}.", list(found.policies)))


def _no_paths(found: Findings) -> Html:
    reasons = [reason for name, reason in found.why_not.items() if name.startswith("paths")]
    return joined(missing(reason) for reason in reasons or ["No policy is known, so that nothing can be simulated."])


def trajectories(found: Findings, gallery: Gallery) -> Html:
    """States and inputs over time."""
    if not found.paths:
        return _no_paths(found)
    drawn = gallery.trajectories()
    total = found.problem.state_size + found.problem.input_size
    which = "" if len(drawn) == total else f" Shown are the {len(drawn)} of {total} signals that vary most."
    cut = "" if found.problem.is_finite else f" The infinite horizon is cut off after {STEPS} steps."
    caption = (
        f"In the middle the median of {found.samples} simulated paths; between the outer lines nine paths in ten. Each "
        f"policy acts in the world that it makes.{which}{cut}"
    )
    partly = [missing(f"{name}: {reason}") for name, reason in found.why_not.items() if name.startswith("paths of")]
    return Html(legend(list(found.paths)) + figures(drawn, caption) + joined(partly))


def distribution(found: Findings, gallery: Gallery) -> Html:
    """The cost of single paths."""
    if not found.paths:
        return _no_paths(found)
    caption = "The cost of single paths. Upright lines: the means. One path in 200 lies beyond either end of the axis."
    rows = []
    for name, paths in found.paths.items():
        costs = np.asarray(paths.cost, dtype=float)
        quantiles = np.quantile(costs, [0.05, 0.5, 0.95, 0.99])
        spread = costs.std(ddof=1) / np.sqrt(len(costs)) if len(costs) > 1 else np.nan
        rows.append(
            [
                name,
                *(number(value, 4) for value in quantiles),
                joined([number(costs.mean(), 5), " ± ", number(spread, 2)]),
            ]
        )
    header = ["Policy", "5 %", "Median", "95 %", "99 %", "Mean of the paths"]
    return Html(
        figures(gallery.costs(), caption)
        + table(f"Costs of {found.samples} simulated paths: so many are below", header, rows)
    )


def contributions(found: Findings, gallery: Gallery) -> Html:
    """What each time adds to the certificates that split, the exact local rate first."""
    split = [
        one for one in found.certificates if one.contributions is not None and np.isfinite(one.contributions).all()
    ]
    split.sort(key=lambda one: one.kind != Sharp.name)
    if split:
        parts = []
        for one in split:
            sides = f"{one.lhs:.4g} {'<' if one.holds else '≥'} {one.rhs:.4g}"
            parts.append(f"{one.kind}, {sides}, most from t = {int(np.argmax(contributions_of(one)))}")
        caption = (
            "What each time adds to the left side of a certificate. Sharp: exactly, how fast the local rate of "
            "retraining grows with the reaction of Δ_t. The others: the sensitivity ε_t times how far it carries, in "
            "their bounds. "
            f"{'; '.join(parts)}."
        )
        headings = ["Local rate (sharp)" if one.kind == Sharp.name else f"Bound ({one.kind})" for one in split]
        return figures([gallery.contributions(one) for one in split], caption, headings)
    lacking = Html('what the others lack is said under <a href="#existence">Does a stable policy exist?</a>')
    return Html(missing("No certificate that splits by time is applicable: ").replace("</p>", f"{lacking}.</p>"))


def landscape(found: Findings, gallery: Gallery) -> Html:
    """The three views."""
    if found.landscape is None:
        return missing(found.why_not.get("landscape", "It was not computed."))
    plane = (
        "First, the plane through the three policies: shades in each one's own world, lines in that of the stable one. "
        if found.landscape.has_plane
        else "The three policies lie on one line, so that there is no plane to show. "
    )
    caption = (
        f"Shades: costs, darker is dearer. {plane}Then the line through stable and optimal policy: each column is a "
        "world, and what is deployed stands on the diagonal; the dashed best response crosses it at the stable policy, "
        "arrows are retraining. Last, the same as curves: the thick one in each policy's own world, red in that of the "
        "stable, blue in that of the optimal policy. Circle: stable; star: optimal; square: naive. Hatched: no finite "
        "cost; blank: not feasible."
    )
    return figures(gallery.landscape(), caption)


def computed(found: Findings) -> Html:
    """Seed, precision, versions, times, statistics of the runs."""
    body = paragraph(
        f"Simulated paths come from the seed {found.seed}, {found.samples} for each policy. The problem is held in "
        f"{np.dtype(found.problem.dtype).name}; what is exact is computed in double precision."
    )
    body += table("Versions", ["Package", "Version"], [[name, value] for name, value in versions().items()])
    rows = [[name, f"{seconds:.1f}"] for name, seconds in found.seconds.items()]
    body += table("Time taken by each part, in seconds, compilation included", ["Part", "Seconds"], rows)
    for name, run in found.runs.items():
        stats = [f"{key.replace('_', ' ')}: {short(value)}" for key, value in run.stats.items()]
        body += subheading(f"The run “{name}”") + bullets([f"steps: {int(run.steps)}", *stats])
    return Html(body)
