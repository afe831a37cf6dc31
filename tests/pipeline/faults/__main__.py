"""`python -m tests.pipeline.faults [FIRST COUNT]`: run fault schedules, and print a table of their numbers; with
`--count`, print only the table."""

import argparse
import os
import resource
import sys
import traceback
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.pipeline.faults.schedules import schedule_of, table


def run() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.pipeline.faults")
    parser.add_argument("first", type=int, nargs="?", default=0, help="seed of the first schedule")
    parser.add_argument("count", type=int, nargs="?", default=520, help="number of schedules")
    parser.add_argument("--count", action="store_true", dest="only", help="print only the table of schedules")
    arguments = parser.parse_args()
    schedules = [schedule_of(seed) for seed in range(arguments.first, arguments.first + arguments.count)]
    if arguments.only:
        print(table(schedules))
        return 0
    from tests.pipeline.faults.campaign import Campaign
    from tests.pipeline.faults.process import set_up
    from tests.pipeline.servers import bucket_of, serving

    failed, missed = 0, 0
    with TemporaryDirectory(prefix="faults-") as name, serving(bucket_of(Path(name) / "s3")) as server:
        os.environ |= {"AWS_ACCESS_KEY_ID": "any", "AWS_SECRET_ACCESS_KEY": "any", "AWS_REGION": "us-east-1"}
        os.environ |= {"AWS_ENDPOINT_URL": server.url, "LEVELPROOF_CACHE_DIR": f"{name}/cache"}
        set_up()
        campaign = Campaign(Path(name), server)
        for schedule in schedules:
            start = cpu_seconds()
            try:
                missed += not campaign.run(schedule)
            except Exception:
                failed += 1
                print(f"FAILED {schedule}\n{traceback.format_exc(limit=-3)}\n", flush=True)
            print(f"{schedule} ({cpu_seconds() - start:.1f} s of a core)", flush=True)
    print(table(schedules))
    print(f"{len(schedules)} schedules, {failed} failed; in {missed} the command ended before its fault.")
    if tests_nothing := missed > max(1, len(schedules) // 4):
        print("FAILED because too few faults happened: the commands' effects are no longer seen.\n")
    return bool(failed) or tests_nothing


def cpu_seconds() -> float:
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


if __name__ == "__main__":
    sys.exit(run())
