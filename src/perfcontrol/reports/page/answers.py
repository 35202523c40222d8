"""The answers of a report: does a stable policy exist, and what does each policy cost?"""

from perfcontrol.reports.page.findings import SAME, Findings
from perfcontrol.reports.page.markup import Html, bullets, joined, missing, number, paragraph, subheading, table
from perfcontrol.theory import KINDS, Certificate, PriceOfStability

MEANINGS = {
    "naive": "best in the world as it was before",
    "stable": "best in the world that it makes: retraining rests there",
    "optimal": "cheapest in the world that it makes",
}


def with_error(standard_error: float | None) -> str:
    """What follows an estimate."""
    return "" if standard_error is None else f" ± {standard_error:.2g}"


def existence_in_words(found: Findings) -> str:
    """One sentence."""
    best = found.existence()
    if best is not None:
        verdict = "A stable policy exists" if best.exists else "No stable policy exists"
        return f"{verdict} ({best.existence_status}): {best.existence}."
    if "stable" in found.policies:
        return "A stable policy was found by the solver; that one exists is not proved otherwise."
    return "Whether a stable policy exists is open: none was found, and no argument that there is one applies."


def existence(found: Findings) -> Html:
    """Whether a stable policy exists, and how that is known."""
    body = paragraph(
        existence_in_words(found),
        "Four certificates ask whether retraining, by best responses to the last world, comes together at one stable "
        "policy. Proved means that it follows from the problem as given; declared, that it rests on somebody's word; "
        "estimated, that it was computed at points or from samples.",
    )
    rows = []
    for one in found.certificates:
        holds = "not applicable" if not one.applicable else "holds" if one.holds else "does not hold"
        exists = {True: "yes", False: "no", None: "open"}[one.exists]
        known = f"{exists} ({one.existence_status})" if one.existence_status else exists
        rows.append(
            [one.kind, holds, known, *(number(value, 4) if one.applicable else "–" for value in (one.lhs, one.rhs))]
        )
    if rows:
        body += table(
            "The four certificates; one that is applicable holds where its left side is below its right side",
            ["Certificate", "Verdict", "A stable policy exists", "Left side", "Right side"],
            rows,
        )
        body += joined(_verdict(one) for one in found.certificates)
    absent = [kind for kind in KINDS if f"certificate {kind}" in found.why_not]
    return Html(body + joined(missing(f"{kind}: {found.why_not[f'certificate {kind}']}") for kind in absent))


def _verdict(certificate: Certificate) -> Html:
    """One certificate in words: what it finds, what it lacks, what it rests on. Existence is said above, once."""
    body = subheading(certificate.kind)
    if not certificate.applicable:
        return Html(
            body
            + paragraph("Not applicable, which says nothing against the problem. Missing:")
            + bullets(certificate.missing)
        )
    body += paragraph(certificate.verdict, *certificate.notes)
    return Html(body + paragraph("It rests on:") + bullets(certificate.assumptions))


def costs(found: Findings) -> Html:
    """C_T(M; M) of each policy, and the price of stability."""
    body = Html("")
    rows = []
    cheapest = min((cost.value for cost in found.costs.values()), default=0.0)
    for name in found.policies:
        cost = found.costs.get(name)
        meaning = MEANINGS.get(name, "of the run that was given")
        if cost is None:
            rows.append([name, meaning, found.why_not.get(f"cost of {name}", "not computed"), "–"])
            continue
        value = joined(
            [number(cost.value), " ± ", number(cost.standard_error, 2)]
            if cost.standard_error is not None
            else [number(cost.value)]
        )
        ratio = number(cost.value / cheapest, 4) if cheapest > 0 else Html("–")
        rows.append([name, meaning, value, ratio])
    unit = "" if found.problem.is_finite else ", on average per stage"
    how = "exact" if found.exact else f"means of {found.samples} simulated paths with their standard errors"
    if rows:
        caption = f"C_T(M; M), what each policy costs in the world that it makes{unit}; {how}"
        body += table(caption, ["Policy", "It is", "Cost", "Relative to the cheapest"], rows)
    if found.price is not None:
        body += _price(found.price)
    else:
        body += _price_missing(found)
    for name, other in found.same.items():
        body += paragraph(f"The run “{name}” found the {other} policy, to within {SAME:g} of its norm.")
    return Html(body)


def _price(price: PriceOfStability) -> Html:
    """What stability and ignorance cost, and how good the optimum is known to be."""
    rows: list[list[object]] = [["price of stability", "stable over optimal", number(price.ratio)]]
    rows.append(["saved by foresight", "stable less optimal", number(price.excess_stable)])
    rows.append(["price of ignoring the reaction", "naive over optimal", number(price.ratio_naive)])
    bound = price.bound
    if bound is not None and bound.lower is not None:
        rows.append(["no policy costs less than", bound.status, number(bound.lower)])
        body = Html("")
    else:
        reasons = "nobody looked" if bound is None else "; ".join(bound.missing)
        body = paragraph(f"That no policy is cheaper than the optimal one shown is not proved: {reasons}.")
    return Html(table("What stability costs", ["Number", "What it is", "Value"], rows) + body)


def _price_missing(found: Findings) -> Html:
    body = Html("")
    if not found.exact:
        body += paragraph(
            "The moments of the perturbation are not known, or the cost is not quadratic: the price of stability can "
            "be read off the costs above, up to their standard errors, and is not proved."
        )
    for part in ("policies", "naive policy", "stable policy", "optimal policy", "costs"):
        if part in found.why_not:
            body += missing(f"{part.capitalize()}: {found.why_not[part]}")
    return Html(body)
