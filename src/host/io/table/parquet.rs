//! Reads the rows of a Parquet file as text fields, so that all tables are read in the same way.
//!
//! In: a file. Out: one record per row. A null becomes an empty field, a time stamp becomes a date in UTC. Row groups
//! are read one after another.

use std::fs::File;
use std::path::Path;

use parquet::basic::{LogicalType, TimeUnit};
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::Field;
use parquet::record::reader::RowIter;
use parquet::schema::types::Type;

use super::{TableError, stamp};
use crate::quantity::Timestamp;

pub(super) struct ParquetRows {
    rows: RowIter<'static>,
    number: u64,
    /// For each column, whether it holds time stamps in nanoseconds as integers.
    is_nanos: Vec<bool>,
}

impl ParquetRows {
    /// Opens a file. Also returns the names of its columns.
    pub(super) fn open(path: &Path) -> Result<(Self, Vec<String>), TableError> {
        let name = path.display();
        let file =
            File::open(path).map_err(|error| TableError::of_io(format!("{name}: cannot be read: {error}"), &error))?;
        let reader = SerializedFileReader::new(file)
            .map_err(|error| TableError::Data(format!("{name}: not a Parquet file that can be read: {error}")))?;
        let fields = reader.metadata().file_metadata().schema().get_fields().to_vec();
        let names = fields.iter().map(|field| field.name().to_owned()).collect();
        let is_nanos = fields.iter().map(|field| is_nanos(field)).collect();
        Ok((Self { rows: reader.into_iter(), number: 0, is_nanos }, names))
    }

    pub(super) fn number(&self) -> u64 {
        self.number
    }

    pub(super) fn next(&mut self, record: &mut csv::ByteRecord) -> Result<bool, String> {
        let Some(row) = self.rows.next() else { return Ok(false) };
        let row = row.map_err(|error| format!("after row {}: {error}", self.number))?;
        self.number += 1;
        record.clear();
        for ((_, field), &is_nanos) in row.get_column_iter().zip(&self.is_nanos) {
            record.push_field(text(field, is_nanos).as_bytes());
        }
        Ok(true)
    }
}

fn is_nanos(field: &Type) -> bool {
    matches!(field.get_basic_info().logical_type_ref(), Some(LogicalType::Timestamp(of)) if of.unit == TimeUnit::NANOS)
}

fn text(field: &Field, is_nanos: bool) -> String {
    let date = |count: i64, nanos: i64| stamp::format_utc_micros(Timestamp::from_nanos(count.saturating_mul(nanos)));
    match field {
        Field::Null => String::new(),
        Field::Str(text) => text.clone(),
        Field::Double(value) if value.is_nan() => String::new(),
        Field::Float(value) if value.is_nan() => String::new(),
        Field::Double(value) => value.to_string(),
        Field::Float(value) => value.to_string(),
        Field::TimestampMillis(count) => date(*count, 1_000_000),
        Field::TimestampMicros(count) => date(*count, 1000),
        Field::Long(count) if is_nanos => date(*count, 1),
        other => other.to_string(),
    }
}
