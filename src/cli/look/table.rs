//! Makes the configuration for a table of samples. The columns become messages, and the label describes the cell.

use std::path::Path;

use super::Args;
use crate::cli::common::files::named_from;
use crate::config;
use crate::io::csv_log::{CsvOptions, TableReading};
use crate::io::log::{LogError, LogOptions, LogSource};
use crate::lab::discover::{PackConfiguration, PackLabel};
use packwatch_host::failure::Failure;

/// A table and the pack that it describes.
pub(super) struct PackTable {
    pub(super) reading: TableReading,
    label: PackLabel,
    cells: u16,
    is_total: bool,
}

impl PackTable {
    /// Reads the first file; `None` = it is not a table.
    pub(super) fn read(args: &Args) -> Result<Option<Self>, Failure> {
        let label = args.known.label.unwrap_or_default();
        if let Some(file) = args.write.as_ref().filter(|file| file.exists()) {
            let size = args.reading().options(&config::load(file)?).csv;
            let reading = tables(args, size).map_err(|error| Failure::new(error.to_string()))?;
            return Ok(reading.map(|reading| Self { reading, label, cells: 1, is_total: false }));
        }
        let cells = label.cells.unwrap_or(1);
        let read = |is_total: bool| {
            let size = CsvOptions { cells, series: cells, sensors: 1, pack_total: is_total, ..CsvOptions::default() };
            let size = CsvOptions { capacity_ah: label.capacity_ah, ..size };
            Ok(tables(args, size)?.map(|reading| Self { reading, label, cells, is_total }))
        };
        let hint = "; if it is a pack, say how many cells are in series, such as --label nmc:64Ah:98s";
        let failed = |error: LogError| {
            let is_of_voltage = label.cells.is_none() && error.to_string().contains("voltage");
            Failure::new(format!("{error}{}", if is_of_voltage { hint } else { "" }))
        };
        match read(false) {
            Err(of_cells @ LogError::Data(_)) if cells > 1 => {
                let of_cells = of_cells.to_string();
                read(true).map_err(|error: LogError| match error.to_string() {
                    of_total if of_total == of_cells => Failure::new(of_total),
                    of_total => Failure::new(format!("{of_cells}\n{of_total}")),
                })
            }
            found => found.map_err(failed),
        }
    }

    /// The configuration to be saved as `file`.
    pub(super) fn configuration(&self, args: &Args, file: &Path) -> Result<PackConfiguration, Failure> {
        let (cells, label) = (self.cells, self.label.cell());
        let cell = match (&args.known.model, label) {
            (Some(model), _) => format!("cell_model = {}", toml::Value::from(named_from(file, model)?)),
            (None, Some(label)) => {
                format!("chemistry = {:?}\nrated_capacity_ah = {:?}", label.chemistry.name(), label.rated_ah)
            }
            (None, None) => {
                let question =
                    "which battery is it? give chemistry and capacity, such as --label nmc:2.6Ah for one cell";
                return Err(Failure::new(question));
            }
        };
        let mut database = "VERSION \"\"\nNS_ :\nBS_:\nBU_: Table\n".to_owned();
        let mut message = |id: u32, name: &str, signal: &str| {
            database += &format!("BO_ {id} {name}: 8 Table\n SG_ {signal} Vector__XXX\n");
        };
        message(256, "Pack", "Current : 0|32@1- (0.0001,0) [-200000|200000] \"A\"");
        message(257, "Sensor", "Temperature : 0|16@1- (0.01,0) [-273|327] \"degC\"");
        message(258, "Total", "Voltage : 0|32@1+ (0.0001,0) [0|400000] \"V\"");
        for n in 1..=u32::from(cells) {
            message(512 + n, &format!("Cell{n}"), "Voltage : 0|24@1+ (0.00001,0) [0|167] \"V\"");
        }
        let voltage = match (self.is_total, cells) {
            (true, _) => "pack_voltage]\nsignal = \"Total.Voltage\"",
            (false, 1) => "cell_voltage]\nsignal = \"Cell1.Voltage\"",
            (false, _) => "cell_voltage]\nsignal = \"Cell{n}.Voltage\"",
        };
        let (temperature, open) = match self.reading.has_temperature {
            true => ("\n[[input.temperature]]\nsignal = \"Sensor.Temperature\"\n", None),
            false => {
                ("", Some("which temperature? the table has none that can be read: 25 degrees C (pack.ambient_c)"))
            }
        };
        let own = toml::Value::from(named_from(file, &file.with_extension("dbc"))?);
        let limits: String =
            ["current", "voltage", "temperature"].map(|name| format!("\n[limits.{name}]\nmax_age_s = 90.0\n")).concat();
        let text = format!(
            "# Written by `packwatch look`.\n\n[pack]\ncells = {cells}\n{cell}\n\n[[interface]]\nname = \"vcan0\"\n\n[input]\ndbc = [{own}]\n\n\
             [input.current]\nsignal = \"Pack.Current\"\npositive = \"discharge\"\n\n[input.{voltage}\n{temperature}{limits}\n\
             [transition]\nmin_duration_s = 60.0\n"
        );
        Ok(PackConfiguration { text, database: Some(database), open: open.map(str::to_owned).into_iter().collect() })
    }
}

/// How the first file is read as a table; `None` = it is not a table.
fn tables(args: &Args, size: CsvOptions) -> Result<Option<TableReading>, LogError> {
    let csv = args.reading().csv_options(size);
    let encode_row = Box::new(|_: &[_], _: &mut Vec<_>| 0);
    let options =
        LogOptions { interfaces: Vec::new(), channels: args.channels.clone(), strict: false, csv, encode_row };
    let mut source = LogSource::new([args.files[0].clone()], options);
    source.adopt_foreign();
    source.next_record()?;
    Ok(source.counts().tables.first().cloned())
}
