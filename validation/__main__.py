"""Run experiments, each in a process of its own, and compose their results into one report.

    python -m validation [NAME ...] [--quick] [--out DIR] [--report-only] [--list]

Without names all experiments run: those that measure no times side by side, one on each core, then the others one by one on the idle
machine. Each writes its JSON and pictures; ``runs.json`` records how each went, and when, on which machine, with which versions; and
``report.html`` shows everything in one file. Runs of some experiments keep the records of the others. Exit status 1 if one failed.
"""
from __future__ import annotations

import json
import os
import pathlib
import signal
import resource
import subprocess
import sys
import tempfile
import time
from collections import deque

from validation import experiment, report
from validation.experiments import EXPERIMENTS

TIME_LIMIT = {True: 600, False: 3600}
"""Seconds after which an experiment is stopped, quick or not."""
TAIL = 30
"""Lines of its output that are recorded of a failure."""


def commit() -> str | None:
    """The checkout's, with "+" if files that it has were changed; None outside of git."""
    def git(*arguments):
        return subprocess.run(["git", *arguments], cwd=experiment.ROOT, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def cpu_of_children() -> float:
    """Seconds that all ended processes that this one started, and theirs, computed."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


class Run:
    """One experiment in a process, on one `core`, or on all of them for None."""

    def __init__(self, name: str, quick: bool, out: pathlib.Path, core: int | None):
        self.name, self.core, self.start, self.limit = name, core, time.perf_counter(), TIME_LIMIT[quick]
        self.cpu_seconds = 0.0
        self.log = tempfile.TemporaryFile(mode="w+", errors="replace")
        command = [sys.executable, "-m", f"validation.{name}", "--out", str(out.resolve()), *(["--quick"] if quick else [])]
        pinned = {} if core is None else {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(command, cwd=experiment.ROOT, env={**os.environ, "MPLBACKEND": "Agg", **pinned},
                                        stdin=subprocess.DEVNULL, stdout=self.log, stderr=subprocess.STDOUT, preexec_fn=self._pin,
                                        start_new_session=True)

    def _pin(self):
        if self.core is not None and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {self.core})          # Dr.Jit takes as many threads as there are cores to run on

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.start

    def done(self) -> bool:
        before = cpu_of_children()
        if self.process.poll() is None and self.seconds > self.limit:
            self.log.write(f"stopped after {self.limit} s\n")
            self.stop()
        self.cpu_seconds = cpu_of_children() - before               # of those that have ended: this one, or none
        return self.process.returncode is not None

    def stop(self):
        if hasattr(os, "killpg"):                         # with the processes that it has started
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.wait()

    def tail(self) -> list:
        self.log.seek(0)
        return list(deque(self.log.read().splitlines(), maxlen=TAIL))


class Runner:
    """Runs experiments and keeps ``runs.json`` up to date."""

    def __init__(self, quick: bool, out: pathlib.Path):
        self.quick, self.out, self.start = quick, out, time.perf_counter()
        self.common = {"quick": quick, "commit": commit(), **experiment.versions()}
        self.failed, self.finished, self.total = [], 0, 0

    def run_all(self, names: list) -> None:
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [None]
        alone = [name for name in names if EXPERIMENTS[name].timed and not self.quick]
        self.total = len(names)
        self._run([name for name in names if name not in alone], cores)
        self._run(alone, [None])

    def _run(self, names: list, cores: list) -> None:
        """Run `names`, the longest first, at most one on each of `cores`."""
        waiting = deque(sorted(names, key=lambda name: -EXPERIMENTS[name].minutes))
        free, running = deque(cores), []
        try:
            while waiting or running:
                while waiting and free:
                    running.append(Run(waiting.popleft(), self.quick, self.out, free.popleft()))
                    self._say(f"{running[-1].name} ...")
                time.sleep(0.1)
                for run in [run for run in running if run.done()]:
                    running.remove(run)
                    free.append(run.core)
                    self._record(run)
        finally:
            for run in running:
                run.stop()

    def _record(self, run: Run) -> None:
        status = run.process.returncode
        entry = {"status": status, "seconds": run.seconds, "cpu_seconds": run.cpu_seconds, **self.common}
        self.finished += 1
        if status:
            self.failed.append(run.name)
            entry["output"] = run.tail()
        self._say(f"{run.name}: {'FAILED' if status else 'done'} in {run.seconds:.0f} s ({run.cpu_seconds:.0f} s of CPU), "
                  f"{self.finished} of {self.total}")
        for line in entry.get("output", []):
            print(f"    {line}", flush=True)
        path = self.out / report.RUNS
        runs = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        experiment.write_json(path, {**runs, run.name: entry})

    def _say(self, text: str) -> None:
        minutes, seconds = divmod(int(time.perf_counter() - self.start), 60)
        print(f"{minutes:3d}:{seconds:02d}  {text}", flush=True)


def main(arguments=None) -> int:
    parser = experiment.command_line(__doc__)
    parser.add_argument("name", nargs="*", metavar="NAME", help="experiments to run (default: all); --list names them")
    parser.add_argument("--report-only", action="store_true", help="run nothing, compose the report of the results that there are")
    parser.add_argument("--list", action="store_true", help="list the experiments and what they claim")
    options = experiment.parse(parser, arguments)
    unknown = [name for name in options.name if name not in EXPERIMENTS]
    if unknown:
        parser.error(f"there is no experiment {', '.join(map(repr, unknown))}; choose from {', '.join(EXPERIMENTS)}")
    if options.list:
        for entry in EXPERIMENTS.values():
            print(f"{entry.name:20s} {entry.minutes:3g} min  {entry.claim}")
        return 0
    runner = Runner(options.quick, options.out)
    if not options.report_only:
        try:
            runner.run_all(list(dict.fromkeys(options.name)) or list(EXPERIMENTS))
        except KeyboardInterrupt:
            print(f"\ninterrupted; {runner.finished} of {runner.total} experiments are recorded, --report-only shows them", file=sys.stderr)
            return 130
    path = report.write(options.out)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB" + "".join(f"\nFAILED {name}" for name in runner.failed))
    return int(bool(runner.failed))


if __name__ == "__main__":
    sys.exit(main())
