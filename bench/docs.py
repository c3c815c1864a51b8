"""docs/bench.md of the JSON that `make bench` leaves in build/: every row, what was asked for, whether it is met.

    python3 bench/docs.py build/bench*.json
"""
import json
import pathlib
import re
import sys

NAMES = {"off": "standard", "zhao": "`zhao`", "anchored": "`anchored`"}


def table(head, rows):
    return "\n".join(["| " + " | ".join(head) + " |", "|" + "---|" * len(head)] + ["| " + " | ".join(r) + " |" for r in rows])


def case(r):
    words = [f"{r['dimension']}D", f"{r['particles_per_cell']:g} a cell", f"{r['particles']:,.0f}", r["basis"], NAMES[r["fbar"]]]
    if r["material"] != "neo_hookean":
        words.append(r["material"])
    return ", ".join(words)


def kernel(r):
    times, goal, share = r["times_plain"], r.get("goal_times_plain"), r.get("share_of_limit")
    asked = f"{goal:g}; {goal / 1.25:.2g}" if goal else "-"
    there = f" ({100 * r['goal_share_of_limit']:.0f})" if "goal_share_of_limit" in r else ""
    ns = f"{r['ns_per_particle_step']:.1f}"
    if "goal_ns_on_the_machine_of_the_goals" in r:
        ns += f" ({r['goal_ns_on_the_machine_of_the_goals']:g})"
    return [case(r), ns, f"{1e3 / r['ns_per_particle_step']:.1f}", f"{100 * share:.0f}{there}" if share else "-",
            f"{times:.2f}", asked, r.get("verdict", "-"), f"{r['bytes_per_particle']:.0f}"]  # fmt: skip


KERNEL_HEAD = ["case", "ns a particle-step (goal)", "M/s", "% of limit (goal)", "× plain", "goal; gate", "", "bytes a particle"]


def verdict(r):
    return [r["what"], f"{r['ns_per_particle_step']:.1f}", f"{r['ratio']:.3f}", f"{r['at_most']:.3f}", r["verdict"]]


VERDICT_HEAD = ["what", "ns", "ratio", "at most", ""]


def processor():
    found = re.search(r"model name\s*:\s*(.*)", pathlib.Path("/proc/cpuinfo").read_text())
    return found.group(1) if found else "unknown"


def main():
    rows = [r for path in sys.argv[1:] for r in json.loads(pathlib.Path(path).read_text())]
    of = lambda *groups: [r for r in rows if r["group"] in groups]  # noqa: E731
    calibration = of("calibration")
    print("# What `make bench` measured\n")
    print("Made by `make bench-docs` from the JSON of `make bench` (its groups one after another: `make bench-solver BENCH=kernels` and so on, `runout` among them, and `make bench-recording`). "
          "Every row is a median of rounds in which the things compared took turns (two threads against the mean of two runs of one thread each at the same time, so that what cores lose when both are at work is in both); [design.md](design.md#the-kernels) says what the limits are. In brackets what was asked for, "
          "on the machine of the goals: ns on another machine, and so the share of the limit, are no verdict, the ratios are. Groups that were measured more than once have a row a time: machines that others share change by a factor of 1.5 from one minute to the next, and two threads feel it first.\n")  # fmt: skip
    if calibration:
        fma = sorted(r["multiply_add_ns"] for r in calibration)
        memory = sorted(r["in_place_gb_s"] for r in calibration)
        print(f"Machine: {processor()}, in a virtual machine that others share; a multiply-add of the widest vectors took {fma[0]:.3f} to {fma[-1]:.3f} ns, "
              f"an update in place went at {memory[0]:.0f} to {memory[-1]:.0f} GB/s.\n")  # fmt: skip
    for group, title in (("kernels", "Kernels, neo-Hookean, quadratic B-splines"), ("bases", "Other bases"), ("materials", "Other materials"), ("avx2", "AVX2 on the same machine")):
        if of(group):
            print(f"## {title}\n\n{table(KERNEL_HEAD, map(kernel, of(group)))}\n")
    if of("stages"):
        skip = {"group", "pass", "fbar", "dimension", "ns_per_particle"}
        print("## Stages of the passes\n\nns a particle, each what it adds.\n")
        print(table(["pass", "ns", "stages"], [[f"{r['dimension']}D, {NAMES[r['fbar']]}: {r['pass']}", f"{r['ns_per_particle']:.1f}",
                    ", ".join(f"{k} {v:.1f}" for k, v in r.items() if k not in skip)] for r in of("stages")]) + "\n")  # fmt: skip
    if of("ratios", "threads"):
        print(f"## One against another\n\n{table(VERDICT_HEAD, map(verdict, of('ratios', 'threads')))}\n")
    if of("features"):
        print(f"## Only what a scene needs\n\nDeclared and not used, against not there.\n\n{table(VERDICT_HEAD, map(verdict, of('features')))}\n")
    if of("bytes"):
        print("Bytes a particle with its share of the grid, 100,000 particles; asked for with F̄ and neo-Hookean: 200 in 2D, 320 in 3D.\n")
        print(table(["case", "bytes"], [[case(r), f"{r['bytes_per_particle']:.0f}"] for r in of("bytes")]) + "\n")
    if of("sort"):
        print("## Sorting\n\n" + "\n".join(f"- {r['dimension']}D: a sort that finds all in order takes {r['steps_per_sort']:.2f} steps; what sorting takes of whole runs: the phases below." for r in of("sort")) + "\n")
    if of("growth"):
        print("## Growth\n\n2D, 4 a cell, `zhao`.\n")
        print(table(["particles", "ns", "M/s", "bytes"], [[f"{r['particles']:,.0f}", f"{r['ns_per_particle_step']:.1f}", f"{1e3 / r['ns_per_particle_step']:.1f}", f"{r['bytes_per_particle']:.0f}"] for r in of("growth")]) + "\n")
    for r in of("publishing"):
        print(f"## Publishing\n\nA frame every 100 steps of 102,400 particles, on one thread: {100 * r['share']:.2f} % of its time (at most 2 %: "
              f"{'met' if r['share'] <= 0.02 else 'missed'}); its processor time a step against that without frames, in turns: {r['ratio']:.3f} (middle half {r['middle'][0]:.3f} to {r['middle'][1]:.3f}). "
              f"Sorting takes {100 * r['sort']:.1f} % of this run: water that sloshes, 256 particles a cell.\n")  # fmt: skip
    scenes = of("scenes", "meeting")
    if scenes:
        print("## Scenes\n")
        for r in scenes:
            if "cpu_s" in r:
                tenths = " ".join(f"{r[f'rate_{k}']:.1f}" for k in range(1, 11) if f"rate_{k}" in r)
                skip = re.compile(r"group|scene|particles|steps|cpu_s|rate_|all_phases")
                phases = ", ".join(f"{k} {v:.1f}" for k, v in r.items() if not skip.match(k) and v >= 0.05)
                print(f"- {r['scene']}: {r['particles']:,.0f} particles, {r['steps']:,.0f} steps in {r['cpu_s']:.1f} s of one thread; M particle-steps/s by tenths: {tenths}; phases, %: {phases}; together {r['all_phases']:.1f} %.")  # fmt: skip
            elif "hours" in r:
                print(f"- {r['scene']}: {r['particles']:,.0f} particles, {r['threads']:.0f} thread(s): {r['ns_per_particle_step']:.1f} ns, so {r['hours']:.2f} h for the whole (asked for: 1.5 h on two).")
            elif r["group"] == "meeting":
                print(f"- {r['scene']}: a step in which no thread does anything takes two threads {r['us_an_empty_step']:.2f} µs to begin, to meet and to end; a step on one thread {r['us_a_step_on_one_thread']:.0f} µs: two are at most {r['at_most_times_as_fast']:.2f} times as fast. A cache line took {r['line_there_and_back_ns']:.0f} ns to the other core and back.")  # fmt: skip
        print()
        print(table(VERDICT_HEAD, map(verdict, (r for r in scenes if "what" in r))) + "\n")


if __name__ == "__main__":
    main()
