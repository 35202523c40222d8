"""What a report says, section by section. A section that cannot be made says why."""

from perfcontrol.reports.page import answers, evidence
from perfcontrol.reports.page.figures import Gallery
from perfcontrol.reports.page.findings import Findings
from perfcontrol.reports.page.markup import Html, Section, joined, paragraph
from perfcontrol.reports.page.parts import what_it_is
from perfcontrol.solvers import Result


def sections(found: Findings) -> list[Section]:
    """All of them, in order."""
    gallery = Gallery(found)
    return [
        Section("problem", "The problem", what_it_is(found.problem)),
        Section("existence", "Does a stable policy exist?", answers.existence(found)),
        Section("costs", "What each policy costs", answers.costs(found)),
        Section("convergence", "How the methods get there", evidence.convergence(found, gallery)),
        Section("policy", "The policies, lag by lag", evidence.policies(found, gallery)),
        Section("trajectories", "States and inputs", evidence.trajectories(found, gallery)),
        Section("distribution", "How the cost is distributed", evidence.distribution(found, gallery)),
        Section("contributions", "Which sensitivities count", evidence.contributions(found, gallery)),
        Section("landscape", "The landscape C_T(M; M')", evidence.landscape(found, gallery)),
        Section("computed", "How this was computed", evidence.computed(found)),
    ]


def in_short(found: Findings) -> Html:
    """What a reader in a hurry wants to know."""
    lines = [paragraph(answers.existence_in_words(found))]
    if found.price is not None:
        lines.append(paragraph(str(found.price)))
    elif found.costs:
        costs = [
            f"the {name} policy {value.value:.5g}{answers.with_error(value.standard_error)}"
            for name, value in found.costs.items()
        ]
        lines.append(paragraph(f"Costs, each in the world that the policy makes: {', '.join(costs)}."))
    for name, run in found.runs.items():
        where = f" It is the {found.same[name]} policy." if name in found.same else ""
        lines.append(paragraph(f"The run “{name}” ended after {int(run.steps)} steps: {Result[run.result]}{where}"))
    return joined(lines)
