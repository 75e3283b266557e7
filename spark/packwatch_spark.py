#!/usr/bin/env python3
"""Replays a fleet on Spark: a task for each vehicle, by the same program as by hand.

    spark-submit spark/packwatch_spark.py MANIFEST --config FILE --out DIR [--binary packwatch] [--estimates S] [OPTION...]

MANIFEST is that of `packwatch fleet plan`. MANIFEST, FILE, DIR and the logs must have the same names on driver and executors: a folder that
all of them see. Each task runs `packwatch fleet run` for its vehicle, which writes DIR/VEHICLE; what is complete is not replayed again, so
a task that Spark repeats, or a job that is started again, costs nothing. Other options, such as --csv-sign=charge, go to it as they are. A vehicle that fails, also one in which the program crashes, is a
row with its reason and does not end the job.

Afterwards: `packwatch fleet merge DIR -o TABLES --manifest MANIFEST`. Printed: a line for each vehicle that failed, and the counts. Exit
status 0 also where vehicles failed. `replay` is for programs: it returns the rows as a DataFrame.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

SCHEMA = "vehicle string, outcome string, error string, days double, seconds double"


def replay_vehicle(line: str, command: list[str]) -> dict:
    """Replays the vehicle of one line of a manifest; `command` is that of `fleet run` without the manifest."""
    begun, vehicle = time.monotonic(), json.loads(line)["vehicle"]
    row = {"vehicle": vehicle, "outcome": "failed", "error": None, "days": 0.0}
    with tempfile.NamedTemporaryFile("w", prefix="packwatch-", suffix=".jsonl") as manifest:
        manifest.write(line)
        manifest.flush()
        ran = subprocess.run([*command, manifest.name], capture_output=True, text=True, errors="replace", check=False)
    if ran.returncode == 0:
        (found,) = json.loads(ran.stdout)["vehicles"]
        row |= {"outcome": found["outcome"], "error": found["record"]["error"], "days": found["record"]["days"]}
    else:
        said = ran.stderr.strip()[-2000:] or "nothing was said"
        row["error"] = f"{os.path.basename(command[0])} ended with status {ran.returncode}: {said}"
    return row | {"seconds": time.monotonic() - begun}


def replay(spark, lines: list[str], config: str, out: str, binary: str = "packwatch", estimates: float | None = None,
           more: list[str] | None = None):  # fmt: skip
    """A DataFrame with a row for each vehicle of these lines of a manifest; they are replayed when it is evaluated. Evaluate it once."""
    command = [binary, "fleet", "run", "--json", "--jobs", "1", "--config", config, "--out", out]
    if estimates is not None:
        command += ["--estimates", str(estimates)]
    command += more or []

    def tasks(batches):
        import pyarrow

        for batch in batches:
            rows = [replay_vehicle(line, command) for line in batch.column(0).to_pylist()]
            yield pyarrow.RecordBatch.from_pylist(rows, schema=arrow_schema())

    # The executors' Python needs this module.
    spark.sparkContext.addPyFile(os.path.abspath(__file__))
    # The largest first, a task each: the last tasks are short.
    largest = sorted(lines, key=lambda line: -json.loads(line)["bytes"])
    numbered = spark.sparkContext.parallelize([(line,) for line in largest], max(1, len(largest)))
    return spark.createDataFrame(numbered, "line string").mapInArrow(tasks, SCHEMA)


def arrow_schema():
    import pyarrow

    text, number = pyarrow.string(), pyarrow.float64()
    return pyarrow.schema({"vehicle": text, "outcome": text, "error": text, "days": number, "seconds": number})


def main() -> None:
    from pyspark.sql import SparkSession

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("manifest")
    parser.add_argument("--config", required=True)
    parser.add_argument("--out", required=True)
    parser.add_argument("--binary", default="packwatch")
    parser.add_argument("--estimates", type=float)
    options, more = parser.parse_known_args()
    with open(options.manifest, encoding="utf-8") as file:
        lines = [line for line in file.read().splitlines() if line.strip()]
    if not lines:
        sys.exit(f"{options.manifest}: no vehicle")
    spark = SparkSession.builder.appName("packwatch fleet").getOrCreate()
    frame = replay(spark, lines, os.path.abspath(options.config), os.path.abspath(options.out), options.binary, options.estimates, more)
    rows = frame.collect()
    for row in sorted(rows, key=lambda row: row.vehicle):
        if row.error:
            print(f"failed: {row.vehicle}: {row.error}")
    counts = {word: sum(row.outcome == word for row in rows) for word in ("replayed", "complete", "failed")}
    print(", ".join(f"{count} {word}" for word, count in counts.items()) + f"; {sum(row.days for row in rows):.1f} days in all")
    spark.stop()


if __name__ == "__main__":
    main()
