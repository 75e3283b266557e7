"""Reads exported Parquet tables with pyarrow or duckdb and compares them with the CSV export of the same log.

usage: parquet_peer.py PARQUET_FOLDER CSV_FOLDER; prints "skipped" if neither reader is installed.
"""

import csv
import datetime
import sys
from pathlib import Path


def read(path):
    """Column names and rows of a Parquet file."""
    try:
        import pyarrow.parquet as parquet

        table = parquet.read_table(path)
        columns = [column.to_pylist() for column in table.columns]
        return table.column_names, list(zip(*columns))
    except ImportError:
        import duckdb

        found = duckdb.connect().execute("select * from read_parquet(?)", [str(path)])
        return [column[0] for column in found.description], found.fetchall()


def same(value, text):
    """Whether a value equals the text in the CSV."""
    if value is None:
        return text == ""
    if isinstance(value, bool):
        return text == str(value).lower()
    if isinstance(value, datetime.datetime):
        wanted = datetime.datetime.strptime(text, "%Y-%m-%dT%H:%M:%S.%fZ").replace(tzinfo=datetime.timezone.utc)
        return value.astimezone(datetime.timezone.utc) == wanted
    if isinstance(value, (int, float)):
        return float(text) == value
    return str(value) == text


def main(parquet_folder, csv_folder):
    for name in ["estimates", "half_cycles", "outlook", "alarms"]:
        try:
            names, rows = read(Path(parquet_folder) / f"{name}.parquet")
        except ImportError:
            print("skipped: neither pyarrow nor duckdb is installed")
            return 0
        with open(Path(csv_folder) / f"{name}.csv", newline="") as file:
            reader = csv.reader(file)
            heads, wanted = next(reader), list(reader)
        if (names, len(rows)) != (heads, len(wanted)):
            print(f"{name}: columns {names}, {len(rows)} rows; CSV has {heads}, {len(wanted)}")
            return 1
        for line, (row, texts) in enumerate(zip(rows, wanted), 2):
            for column, value, text in zip(names, row, texts):
                if not same(value, text):
                    print(f"{name}.csv:{line}: {column} = {text!r}, Parquet has {value!r}")
                    return 1
        print(f"{name}: {len(rows)} rows agree")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
