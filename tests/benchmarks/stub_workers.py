"""Many workers of a dask.distributed cluster in one process, to measure the load of the scheduler.

`python stub_workers.py ADDRESS NUMBER`
"""

import asyncio
import sys
from concurrent.futures import ThreadPoolExecutor

import dask
from distributed import Worker

# The periodic self-monitoring of a thousand workers would take all the time of their process.
QUIET = {
    "distributed.admin.tick.interval": "1h",
    "distributed.admin.system-monitor.interval": "1h",
    "distributed.worker.profile.enabled": False,
    "temporary-directory": ".",
}
AT_A_TIME = 50  # that join
THREADS = 4  # threads of all workers together


async def main(address: str, number: int) -> None:
    """Connect to the scheduler and work until the scheduler ends."""
    pool = ThreadPoolExecutor(THREADS)
    workers = [Worker(address, nthreads=1, memory_limit=0, executor=pool) for _ in range(number)]
    for begin in range(0, number, AT_A_TIME):
        await asyncio.gather(*workers[begin : begin + AT_A_TIME])
    await asyncio.gather(*(one.finished() for one in workers))


with dask.config.set(QUIET):
    asyncio.run(main(sys.argv[1], int(sys.argv[2])))
