"""`pc.solve_many` on one device, on two devices of one process, and in two processes: what the second one brings.

    python -m benchmarks.processes [--seeds 128] [--steps 1500] [--rounds 5]

The work is the same: RSGD for every seed on the dense problem of the tables of speed, float64, compiled before time is
taken. "Two that do not meet" is two processes with half of the seeds each and no exchange: what the machine itself
allows. Efficiency is the time of one device over twice the time.
"""

import argparse
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SAID = "took "
ROOT = Path(__file__).parents[1]


def worker(options: argparse.Namespace) -> None:
    """One process: compile, then at every line of standard input do the work and print how long it took."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", options.devices)
    if options.address:
        jax.distributed.initialize(options.address, 2, options.process)
    import perfcontrol as pc
    from benchmarks.problems import problem_of

    keys = jax.random.split(pc.fast_key(0), options.seeds)
    problem, solver = problem_of(20, 1, 60), pc.RSGD(options.steps, 1e-4)
    pc.solve_many(problem, solver, keys=keys).M.block_until_ready()
    say(0.0)
    for _ in sys.stdin:
        began = time.perf_counter()
        pc.solve_many(problem, solver, keys=keys).M.block_until_ready()
        say(time.perf_counter() - began)


def say(seconds: float) -> None:
    """To the team, on standard output, where gloo writes as well."""
    sys.stdout.write(f"{SAID}{seconds}\n")
    sys.stdout.flush()


def heard(member: subprocess.Popen[str]) -> float:
    """The seconds that a worker says next."""
    assert member.stdout is not None
    return float(next(line for line in member.stdout if line.startswith(SAID)).removeprefix(SAID))


class Team:
    """Processes that work at the same time."""

    def __init__(self, options: argparse.Namespace, processes: int, devices: int, meet: bool):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free.getsockname()[1]}"
        seeds = options.seeds if processes == 1 or meet else options.seeds // processes
        command = [sys.executable, "-m", "benchmarks.processes", "--worker", "--seeds", str(seeds)]
        command += ["--steps", str(options.steps), "--devices", str(devices)]
        self.members = [
            subprocess.Popen(
                [*command, *(["--address", address, "--process", str(number)] if meet else [])],
                cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            )
            for number in range(processes)
        ]  # fmt: skip
        for member in self.members:
            heard(member)

    def work(self) -> float:
        """Seconds until the last one has ended."""
        for member in self.members:
            assert member.stdin is not None
            member.stdin.write("\n")
            member.stdin.flush()
        return max(heard(member) for member in self.members)

    def end(self) -> None:
        # All at once: a process that ends alone is an error to the one that it works with.
        for member in self.members:
            assert member.stdin is not None
            member.stdin.close()
        for member in self.members:
            member.wait()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("seeds", 128), ("steps", 1500), ("rounds", 5), ("devices", 1), ("process", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker(options)
        return
    layouts = {
        "one process, one device": (1, 1, False),
        "one process, two devices": (1, 2, False),
        "two processes, one device each": (2, 1, True),
        "two that do not meet": (2, 1, False),
    }
    teams = {name: Team(options, *layout) for name, layout in layouts.items()}
    took = np.median([[team.work() for team in teams.values()] for _ in range(options.rounds)], axis=0)
    for team in teams.values():
        team.end()
    lines = ["| layout | time | efficiency |", "| --- | --: | --: |"]
    for name, seconds in zip(teams, took, strict=True):
        efficiency = "" if name == next(iter(teams)) else f"{took[0] / 2 / seconds:.0%}"
        lines.append(f"| {name} | {seconds:.2f} s | {efficiency} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
