//! Writes a table of rows as a Parquet or CSV file.
//!
//! Only the rows of one row group are in memory. The file gets its final name when it is complete ([`ResultFile`]). In
//! a Parquet file, a missing required value or a value of the wrong type is an error.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use parquet::basic::Compression;
use parquet::column::writer::ColumnCloseResult;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int32Type, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::{KeyValue, ParquetMetaDataReader, RowGroupMetaData};
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::parser::parse_message_type;

use super::TableFormat;
use super::columns::{Column, ColumnType, FieldValue};
use crate::error::LabError;
use crate::io::result_file::ResultFile;
use crate::io::stamp;

/// Number of rows of a row group. With this number, a table of estimates needs about 10 MB of memory, and readers can
/// skip row groups.
const GROUP_ROWS: usize = 65_536;

pub(super) struct TableFile<R: 'static> {
    path: PathBuf,
    columns: &'static [Column<R>],
    rows: u64,
    writer: TableWriter,
}

enum TableWriter {
    Csv { out: Box<csv::Writer<ResultFile>>, record: csv::StringRecord },
    Parquet { out: Box<SerializedFileWriter<ResultFile>>, group: Vec<ColumnBuffer>, rows: usize },
}

/// Values of one column in the unfinished row group. `present` states which rows have a value.
struct ColumnBuffer {
    present: Vec<i16>,
    list: ColumnValues,
}

enum ColumnValues {
    Micros(Vec<i64>),
    Reals(Vec<f64>),
    Wholes(Vec<i32>),
    Flags(Vec<bool>),
    Words(Vec<ByteArray>),
}

impl<R> TableFile<R> {
    /// Starts a file.
    ///
    /// # Errors
    /// The file cannot be created. The message names it.
    pub(super) fn create(path: &Path, format: TableFormat, columns: &'static [Column<R>]) -> Result<Self, LabError> {
        let file = ResultFile::create(path)?;
        let writer = match format {
            TableFormat::Csv => {
                let mut out = Box::new(csv::Writer::from_writer(file));
                out.write_record(columns.iter().map(|column| column.name))?;
                TableWriter::Csv { out, record: csv::StringRecord::new() }
            }
            TableFormat::Parquet => {
                let schema = parse_message_type(&schema(columns))?;
                let properties = WriterProperties::builder()
                    .set_compression(Compression::SNAPPY)
                    .set_created_by(format!("packwatch {}", env!("CARGO_PKG_VERSION")))
                    .build();
                let out = SerializedFileWriter::new(file, Arc::new(schema), Arc::new(properties));
                let out = Box::new(out.map_err(|error| named_error(path, &error))?);
                let group = columns.iter().map(|column| ColumnBuffer::new(column.kind)).collect();
                TableWriter::Parquet { out, group, rows: 0 }
            }
        };
        Ok(Self { path: path.to_owned(), columns, rows: 0, writer })
    }

    /// Writes a row.
    ///
    /// # Errors
    /// The row cannot be written. In a Parquet file, a missing value or a value of the wrong type is also an error.
    pub(super) fn push(&mut self, row: &R) -> Result<(), LabError> {
        self.rows += 1;
        match &mut self.writer {
            TableWriter::Csv { out, record } => {
                record.clear();
                self.columns.iter().for_each(|column| record.push_field(&csv_field(&column.value(row))));
                Ok(out.write_record(&*record)?)
            }
            TableWriter::Parquet { out, group, rows } => {
                for (column, values) in self.columns.iter().zip(group.iter_mut()) {
                    if !values.push(column.value(row), column.optional) {
                        let (file, name) = (self.path.display(), column.name);
                        return Err(LabError::Data(format!("{file}: {name} has no value, or a value of another type")));
                    }
                }
                *rows += 1;
                if *rows < GROUP_ROWS {
                    return Ok(());
                }
                *rows = 0;
                write_group(out, group, self.columns).map_err(|error| named_error(&self.path, &error))
            }
        }
    }

    /// Completes the file. Returns the number of rows.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn finish(self, metadata: &[(&'static str, String)]) -> Result<u64, LabError> {
        let Self { path, columns, rows, writer } = self;
        let file = match writer {
            TableWriter::Csv { out, .. } => {
                out.into_inner().map_err(|error| LabError::Data(error.error().to_string()))?
            }
            TableWriter::Parquet { mut out, mut group, rows } => {
                let failed = |error: ParquetError| named_error(&path, &error);
                if rows > 0 {
                    write_group(&mut out, &mut group, columns).map_err(failed)?;
                }
                let units = columns.iter().filter(|column| !column.unit.is_empty());
                let units = units.map(|column| (format!("unit.{}", column.name), column.unit.to_owned()));
                let given = metadata.iter().map(|(key, value)| ((*key).to_owned(), value.clone()));
                given.chain(units).for_each(|(key, value)| out.append_key_value_metadata(KeyValue::new(key, value)));
                out.into_inner().map_err(failed)?
            }
        };
        file.finish()?;
        Ok(rows)
    }
}

/// Copies the row groups of Parquet files into one file, in order. The files must have these columns. Returns the
/// number of rows.
///
/// # Errors
/// A file cannot be read or written, or has other columns.
pub(super) fn concatenate<R>(
    path: &Path,
    parts: &[PathBuf],
    columns: &'static [Column<R>],
    metadata: &[(&'static str, String)],
) -> Result<u64, LabError> {
    let mut whole = TableFile::create(path, TableFormat::Parquet, columns)?;
    let TableWriter::Parquet { out, .. } = &mut whole.writer else { return Err("a table in Parquet".into()) };
    for part in parts {
        let failed = |error: &dyn std::fmt::Display| {
            let help = "remove its folder and replay the vehicle again";
            LabError::Data(format!("{}: cannot be read: {error}; {help}", part.display()))
        };
        let file = std::fs::File::open(part).map_err(|error| failed(&error))?;
        let found = ParquetMetaDataReader::new().parse_and_finish(&file).map_err(|error| failed(&error))?;
        if found.file_metadata().schema() != out.schema_descr().root_schema() {
            return Err(failed(&"other columns than this program writes"));
        }
        for group in found.row_groups() {
            whole.rows += u64::try_from(group.num_rows()).unwrap_or(0);
            append_group(out, &file, group).map_err(|error| named_error(path, &error))?;
        }
    }
    whole.finish(metadata)
}

fn append_group(
    out: &mut SerializedFileWriter<ResultFile>,
    file: &std::fs::File,
    group: &RowGroupMetaData,
) -> Result<(), ParquetError> {
    let mut copy = out.next_row_group()?;
    for column in group.columns() {
        let count = |number: i64| u64::try_from(number).unwrap_or(0);
        let chunk = ColumnCloseResult {
            bytes_written: count(column.compressed_size()),
            rows_written: count(group.num_rows()),
            metadata: column.clone(),
            bloom_filter: None,
            column_index: None,
            offset_index: None,
        };
        copy.append_column(file, chunk)?;
    }
    copy.close().map(drop)
}

fn schema<R>(columns: &[Column<R>]) -> String {
    let line = |column: &Column<R>| {
        let (physical, logical) = column.kind.parquet();
        let presence = if column.optional { "OPTIONAL" } else { "REQUIRED" };
        format!("{presence} {physical} {}{logical};", column.name)
    };
    format!("message packwatch {{ {} }}", columns.iter().map(line).collect::<Vec<_>>().join(" "))
}

/// Adds the file name to an error, unless the error of the operating system already contains it.
fn named_error(path: &Path, error: &ParquetError) -> LabError {
    let (path, text) = (path.display().to_string(), error.to_string());
    LabError::Data(if text.contains(&path) { text } else { format!("{path}: cannot be written: {text}") })
}

fn csv_field(field: &FieldValue<'_>) -> String {
    match field {
        FieldValue::Time(time) => stamp::format_utc_micros(*time),
        // The shortest text that reads back as the same number.
        FieldValue::Real(value) => value.map(|value| format!("{value:?}")).unwrap_or_default(),
        FieldValue::Whole(value) => value.map(|value| value.to_string()).unwrap_or_default(),
        FieldValue::Flag(value) => value.to_string(),
        FieldValue::Word(value) => value.as_deref().unwrap_or_default().to_owned(),
    }
}

impl ColumnBuffer {
    fn new(kind: ColumnType) -> Self {
        let list = match kind {
            ColumnType::Time => ColumnValues::Micros(Vec::new()),
            ColumnType::Real => ColumnValues::Reals(Vec::new()),
            ColumnType::Whole => ColumnValues::Wholes(Vec::new()),
            ColumnType::Flag => ColumnValues::Flags(Vec::new()),
            ColumnType::Word => ColumnValues::Words(Vec::new()),
        };
        Self { present: Vec::new(), list }
    }

    fn push(&mut self, field: FieldValue<'_>, optional: bool) -> bool {
        let present = match (&mut self.list, field) {
            (ColumnValues::Micros(list), FieldValue::Time(time)) => put(list, Some(time.nanos().div_euclid(1000))),
            (ColumnValues::Reals(list), FieldValue::Real(value)) => put(list, value),
            (ColumnValues::Wholes(list), FieldValue::Whole(value)) => {
                put(list, value.map(|value| i32::try_from(value).unwrap_or(i32::MAX)))
            }
            (ColumnValues::Flags(list), FieldValue::Flag(value)) => put(list, Some(value)),
            (ColumnValues::Words(list), FieldValue::Word(value)) => {
                put(list, value.map(|word| ByteArray::from(word.as_ref())))
            }
            _ => return false,
        };
        self.present.push(i16::from(present));
        present || optional
    }
}

fn put<T>(list: &mut Vec<T>, value: Option<T>) -> bool {
    let present = value.is_some();
    list.extend(value);
    present
}

fn write_group<R>(
    out: &mut SerializedFileWriter<ResultFile>,
    group: &mut [ColumnBuffer],
    columns: &[Column<R>],
) -> Result<(), ParquetError> {
    let mut writer = out.next_row_group()?;
    for (values, column) in group.iter_mut().zip(columns) {
        let present = column.optional.then_some(values.present.as_slice());
        match &mut values.list {
            ColumnValues::Micros(list) => write_column::<Int64Type>(&mut writer, list, present)?,
            ColumnValues::Reals(list) => write_column::<DoubleType>(&mut writer, list, present)?,
            ColumnValues::Wholes(list) => write_column::<Int32Type>(&mut writer, list, present)?,
            ColumnValues::Flags(list) => write_column::<BoolType>(&mut writer, list, present)?,
            ColumnValues::Words(list) => write_column::<ByteArrayType>(&mut writer, list, present)?,
        }
        values.present.clear();
    }
    writer.close().map(drop)
}

fn write_column<T: DataType>(
    writer: &mut SerializedRowGroupWriter<'_, ResultFile>,
    list: &mut Vec<T::T>,
    present: Option<&[i16]>,
) -> Result<(), ParquetError> {
    let missing = || ParquetError::General("more columns than the schema has".to_owned());
    let mut column = writer.next_column()?.ok_or_else(missing)?;
    column.typed::<T>().write_batch(list, present, None)?;
    list.clear();
    column.close()
}

#[cfg(test)]
mod tests;
