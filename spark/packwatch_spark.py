#!/usr/bin/env python3
"""Replays a fleet on Spark: one task per vehicle, each running the packwatch program.

    spark-submit spark/packwatch_spark.py MANIFEST --config FILE --out DIR [--binary packwatch] [--estimates S] [OPTION...]

MANIFEST comes from `packwatch fleet plan`. MANIFEST, FILE, DIR and the logs need the same paths on driver and executors, so use a shared
folder. Each task runs `packwatch fleet run` for its vehicle, which writes DIR/VEHICLE. Complete vehicles are not replayed again, so a
repeated task or a restarted job costs little. Other options, such as --csv-sign=charge, are passed on. If a vehicle fails, even by a
crash of the program, its row has the reason and the job continues.

Afterwards run `packwatch fleet merge DIR -o TABLES --manifest MANIFEST`. This program prints a line for each failed vehicle, and the
counts. The exit status is 0 even if vehicles failed. To get the rows as a DataFrame in a program, call `replay`.
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
    """Replays the vehicle of one manifest line; `command` is `fleet run` without the manifest."""
    begun, vehicle = time.monotonic(), json.loads(line)["vehicle"]
    row = {"vehicle": vehicle, "outcome": "failed", "error": None, "days": 0.0}
    with tempfile.NamedTemporaryFile("w", prefix="packwatch-", suffix=".jsonl") as manifest:
        manifest.write(line)
        manifest.flush()
        ran = subprocess.run([*command, manifest.name], capture_output=True, text=True, errors="replace", check=False)
    # With status 1, the JSON document states why the vehicle failed.
    if ran.stdout.startswith("{"):
        (found,) = json.loads(ran.stdout)["vehicles"]
        row |= {"outcome": found["outcome"], "error": found["record"]["error"], "days": found["record"]["days"]}
    else:
        said = ran.stderr.strip()[-2000:] or "no message"
        row["error"] = f"{os.path.basename(command[0])} ended with status {ran.returncode}: {said}"
    return row | {"seconds": time.monotonic() - begun}


def replay(spark, lines: list[str], config: str, out: str, binary: str = "packwatch", estimates: float | None = None,
           more: list[str] | None = None):  # fmt: skip
    """Returns a DataFrame with a row per manifest line. Each evaluation of the DataFrame replays the vehicles, so evaluate it once."""
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
    # One task per vehicle. The vehicles with the largest logs come first, so that the last tasks are short.
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
        sys.exit(f"{options.manifest}: no vehicles")
    spark = SparkSession.builder.appName("packwatch fleet").getOrCreate()
    frame = replay(spark, lines, os.path.abspath(options.config), os.path.abspath(options.out), options.binary, options.estimates, more)
    rows = frame.collect()
    for row in sorted(rows, key=lambda row: row.vehicle):
        if row.error:
            print(f"failed: {row.vehicle}: {row.error}")
    counts = {word: sum(row.outcome == word for row in rows) for word in ("replayed", "complete", "failed")}
    print(", ".join(f"{count} {word}" for word, count in counts.items()) + f"; {sum(row.days for row in rows):.1f} days in total")
    spark.stop()


if __name__ == "__main__":
    main()
