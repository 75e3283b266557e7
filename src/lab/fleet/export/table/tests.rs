//! Tests that readers of Parquet and CSV can read the tables.

use std::fs;

use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::RowAccessor;

use super::super::columns::ESTIMATES;
use super::super::rows::EstimateRow;
use super::*;
use crate::monitor::{Estimate, MeasuredValues};
use crate::quantity::{CellIndex, Timestamp};

fn row(index: u32) -> EstimateRow {
    let number = f64::from(index);
    let estimate = Estimate {
        time: Timestamp::from_nanos(1_700_000_000_123_456_789 + i64::from(index) * 1_000_000_000),
        cell: CellIndex(7),
        soc: 0.1 + number * 1e-6,
        soc_std: f64::NAN,
        branch_v: [0.01, f64::NAN, f64::NAN],
        capacity_ah: 2.5,
        capacity_std_ah: 0.1,
        resistance_ratio: 1.0,
        resistance_ratio_std: 0.1,
        innovation_v: f64::NAN,
        innovation_std_v: f64::NAN,
        accepted: index.is_multiple_of(2),
        measured: MeasuredValues { voltage_v: 3.7, current_a: -1.0, temperature_c: 25.0 },
    };
    EstimateRow { log: "life".into(), since_s: number, estimate }
}

fn written(format: TableFormat, rows: u32) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("estimates");
    let mut table = TableFile::create(&path, format, ESTIMATES).expect("created");
    (0..rows).for_each(|index| table.push(&row(index)).expect("written"));
    assert!(!path.exists(), "no name before it is complete");
    assert_eq!(table.finish(&[("packwatch.log", "life.log".to_owned())]), Ok(u64::from(rows)));
    (folder, path)
}

#[test]
fn parquet_reads_back_over_several_row_groups() {
    let rows = u32::try_from(GROUP_ROWS).expect("small") + 10;
    let (_folder, path) = written(TableFormat::Parquet, rows);
    let reader = SerializedFileReader::new(fs::File::open(path).expect("there")).expect("Parquet");
    assert_eq!(reader.metadata().num_row_groups(), 2);
    let metadata = reader.metadata().file_metadata().key_value_metadata().expect("metadata");
    let value = |key: &str| metadata.iter().find(|pair| pair.key == key).and_then(|pair| pair.value.clone());
    assert_eq!(value("packwatch.log").as_deref(), Some("life.log"));
    assert_eq!(value("unit.capacity_ah").as_deref(), Some("Ah"));
    let mut count = 0;
    for (index, found) in (0..).zip(reader.get_row_iter(None).expect("rows")) {
        let (found, wanted) = (found.expect("a row"), row(index));
        assert_eq!(found.get_string(0).expect("log"), "life");
        assert_eq!(found.get_timestamp_micros(1).expect("time"), wanted.estimate.time.nanos() / 1000);
        assert_eq!(found.get_int(3).expect("cell"), 7);
        assert_eq!(found.get_double(4).expect("soc"), wanted.estimate.soc);
        assert!(found.get_double(5).is_err(), "not a number is null");
        assert_eq!(found.get_bool(15).expect("accepted"), wanted.estimate.accepted);
        count += 1;
    }
    assert_eq!(count, rows);
}

#[test]
fn csv_has_the_same_columns_and_empty_fields() {
    let (_folder, path) = written(TableFormat::Csv, 1);
    let text = fs::read_to_string(path).expect("there");
    let lines: Vec<&str> = text.lines().collect();
    assert!(lines[0].starts_with("log,time,since_start_s,cell,soc,soc_std,u1_v"));
    assert!(lines[1].starts_with("life,2023-11-14T22:13:20.123456Z,0.0,7,0.1,,0.01,,,2.5"), "{}", lines[1]);
}

#[test]
fn table_without_rows_has_all_columns() {
    let (_folder, path) = written(TableFormat::Parquet, 0);
    let reader = SerializedFileReader::new(fs::File::open(path).expect("there")).expect("Parquet");
    assert_eq!(reader.metadata().file_metadata().num_rows(), 0);
    assert_eq!(reader.metadata().file_metadata().schema_descr().num_columns(), ESTIMATES.len());
}
