"""Many workers of a dask.distributed cluster in one process: what they ask of the scheduler, on one machine.

`python stub_workers.py ADDRESS NUMBER`
"""

import asyncio
import sys
from concurrent.futures import ThreadPoolExecutor

import dask
from distributed import Worker

# What a worker looks after by itself, fifty times a second, takes all the time of a process of a thousand.
QUIET = {
    "distributed.admin.tick.interval": "1h",
    "distributed.admin.system-monitor.interval": "1h",
    "distributed.worker.profile.enabled": False,
    "temporary-directory": ".",
}
AT_A_TIME = 50  # that join
THREADS = 4  # of all workers together


async def main(address: str, number: int) -> None:
    """Join, and work until the scheduler ends."""
    pool = ThreadPoolExecutor(THREADS)
    workers = [Worker(address, nthreads=1, memory_limit=0, executor=pool) for _ in range(number)]
    for begin in range(0, number, AT_A_TIME):
        await asyncio.gather(*workers[begin : begin + AT_A_TIME])
    await asyncio.gather(*(one.finished() for one in workers))


with dask.config.set(QUIET):
    asyncio.run(main(sys.argv[1], int(sys.argv[2])))
