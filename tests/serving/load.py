"""Load on the policy server: how many requests it answers, what it adds to a policy call, and how much memory it takes.

    python -m tests.serving.load                    # 1, 8 and 64 clients, server and clients on a core each
    python -m tests.serving.load fleet=8 rounds=4   # and the same robots as processes that each load the policy, on one core

Prints Markdown rows. Rounds of what is compared alternate, and rates of the fleet are per second of CPU time, of all threads of
the server or of all processes: on a machine that does other work eight processes get more of a core than one.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import re
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import msgpack
import numpy as np
from websockets.asyncio.client import connect

from tests.serving.robots import packed, unpacked

OPTIONS = {
    "policy": "assets/lift", "method": "ddpm5_logsnr:int8", "clients": "1,8,64", "seconds": "5", "rounds": "3", "fleet": "0",
}  # fmt: skip
CORE = {"policy": 0, "clients": 1}


@contextmanager
def served(options, answers):
    """The recipe as a program on its core; gives its port and process."""
    command = [sys.executable, "recipes/serve.py", "port=0", f"answers={answers}", "report_every=3600"]
    words = [f"{name}={options[name]}" for name in ("policy", "method")]
    process = subprocess.Popen(
        [*command, *words], stdout=subprocess.PIPE, text=True, preexec_fn=lambda: pin("policy")
    )
    try:
        yield int(re.search(r"ws://[^:]+:(\d+)", process.stdout.readline())[1]), process
    finally:
        process.terminate()
        process.wait(30)


def pin(part):
    os.sched_setaffinity(0, {CORE[part] % os.cpu_count()})


def memory(pid):
    """Resident MB of a process: its own, and of files, which processes share."""
    text = Path(f"/proc/{pid}/status").read_text()
    return [int(re.search(rf"^Rss{kind}:\s+(\d+)", text, re.M)[1]) / 1024 for kind in ("Anon", "File")]


def busy(pid):
    """CPU seconds of a server's event loop, which is its main thread, and of all its other threads."""
    times = {
        int(task.name): int((task / "schedstat").read_text().split()[0])
        for task in Path(f"/proc/{pid}/task").iterdir()
    }
    loop = times.pop(pid)
    return np.array([loop, sum(times.values())]) / 1e9


async def drive(port, clients, seconds, shape):
    """Requests of so many robots, one after the other each; returns [n, 2]: seconds of a request, and of its policy call."""
    message = msgpack.packb({"observation/state": np.zeros(shape)}, default=packed)
    taken, end = [], time.perf_counter() + seconds

    async def play():
        async with connect(f"ws://127.0.0.1:{port}", compression=None) as socket:
            await socket.recv()
            while time.perf_counter() < end:
                begin = time.perf_counter()
                await socket.send(message)
                answer = await socket.recv()
                took = time.perf_counter() - begin
                told = msgpack.unpackb(answer, object_hook=unpacked)
                taken.append((took, told["server_timing"]["policy_ms"] / 1000))

    await asyncio.gather(*(play() for _ in range(clients)))
    return np.array(taken)


def process_robot(options, answers, begin, end, counts, spent, number):
    """One of the processes that each load the policy; begins a round when told so."""
    import torch

    from torchrl_sparse import ChunkExecutor, DiffusionPolicy, make_method

    torch.set_num_threads(1)
    policy = DiffusionPolicy.from_pretrained(options["policy"])
    made = {"num_updates": 10, "planners": Path(options["policy"]), "calibration": None}
    actor = ChunkExecutor(
        make_method(options["method"], policy, **made).freeze(), 8 if answers == "action" else 1
    )
    actor.reset(seed=number)
    observation = {"state": np.zeros(policy.normalizer.state_scale.numel())}
    actor.act(observation)
    pin("policy")
    while True:
        begin.wait()
        count, stop = 0, time.perf_counter() + float(options["seconds"])
        before = time.process_time()
        while time.perf_counter() < stop:
            actor.act(observation)
            count += 1
        counts[number], spent[number] = count, time.process_time() - before
        end.wait()


def table(options, state):
    """Rows of the load of 1, 8 and 64 clients."""
    print(
        "| answers | clients | requests/s | call, ms | added, ms | added at most in 99 %, ms | from the chunk, ms "
        "| loop's CPU a request, ms | other CPU a policy call, ms | memory, MB |"
    )
    for answers, shape in (("action", state[-1:]), ("chunk", state)):
        with served(options, answers) as (port, process):
            for clients in map(int, options["clients"].split(",")):
                before = busy(process.pid)
                taken = asyncio.run(drive(port, clients, float(options["seconds"]), shape))
                loop, other = 1000 * (busy(process.pid) - before)
                called = taken[taken[:, 1] > 0]
                added = 1000 * (called[:, 0] - called[:, 1])
                within = 1000 * taken[taken[:, 1] == 0, 0]
                cells = [
                    len(taken) / float(options["seconds"]), 1000 * np.median(called[:, 1]), *np.percentile(added, (50, 99)),
                    np.median(within) if len(within) else np.nan, loop / len(taken), other / len(called),
                    sum(memory(process.pid)),
                ]  # fmt: skip
                print(
                    f"| {answers} | {clients} | " + " | ".join(f"{cell:.3g}" for cell in cells) + " |",
                    flush=True,
                )


def fleet(options, state):
    """Rates of one server and of as many processes as it has robots, all on one core, in alternating rounds."""
    robots, seconds = int(options["fleet"]), float(options["seconds"])
    fork = multiprocessing.get_context("fork")  # what they import is there already; the policy is not
    for answers, shape in (("action", state[-1:]), ("chunk", state)):
        shared = [
            fork.Barrier(robots + 1),
            fork.Barrier(robots + 1),
            fork.Array("q", robots),
            fork.Array("d", robots),
        ]
        begin, end, counts, spent = shared
        arguments = [(options, answers, *shared, number) for number in range(robots)]
        processes = [fork.Process(target=process_robot, args=one, daemon=True) for one in arguments]
        for process in processes:
            process.start()
        with served(options, answers) as (port, server):
            found = []
            for number in range(int(options["rounds"]) + 1):
                begin.wait()
                end.wait()
                alone = sum(counts) / sum(spent)
                before = sum(busy(server.pid))
                together = len(asyncio.run(drive(port, robots, seconds, shape))) / (
                    sum(busy(server.pid)) - before
                )
                if number:  # the first warms up
                    found.append((together, alone, together / alone))
            (own, files), (each, _) = memory(server.pid), memory(processes[0].pid)
        rounds = ", ".join(f"{row[2]:.3g}" for row in found)
        together, alone, ratio = np.median(found, axis=0)
        print(
            f"{answers}: a CPU second: server {together:.4g}, {robots} processes {alone:.4g}, ratio {ratio:.3g} of {rounds}"
        )
        print(
            f"server {own:.0f} MB and {files:.0f} of files, each process {each:.0f} and those files",
            flush=True,
        )
        for process in processes:
            process.terminate()


def main():
    options = OPTIONS | dict(word.split("=", 1) for word in sys.argv[1:])
    from torchrl_sparse import (  # noqa: F401  for those that are forked
        ChunkExecutor,
        DiffusionPolicy,
        make_method,
    )

    policy = DiffusionPolicy.from_pretrained(options["policy"])
    state = (policy.n_obs_steps, policy.normalizer.state_scale.numel())
    pin("clients")
    if options["clients"] != "0":
        table(options, state)
    if options["fleet"] != "0":
        fleet(options, state)


if __name__ == "__main__":
    main()
