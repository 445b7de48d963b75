"""Align a flight on the workers of a Dask cluster or, without an address, on worker processes of this machine.

pip install '.[dask]'
python examples/on_dask.py FLIGHT OUT [tcp://SCHEDULER:8786]
"""

import sys

import agalign


def main() -> None:
    if len(sys.argv) < 3:
        sys.exit("usage: python examples/on_dask.py FLIGHT OUT [tcp://SCHEDULER:8786]")
    address = sys.argv[3] if len(sys.argv) > 3 else "local"
    with agalign.dask_executor(address, jobs=2) as executor:
        for report in agalign.align_folder(sys.argv[1], sys.argv[2], run=agalign.RunOptions(executor=executor)):
            print(report.label, report.state, report.error or "")


if __name__ == "__main__":
    main()
