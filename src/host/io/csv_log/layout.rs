//! Chooses the columns of a table of samples.
//!
//! In: the header and the options. Out: a [`Layout`] with the column and the unit of each role. If the user names a
//! column for a role, this column is used. Otherwise, a column whose name is in the [dictionary](super::dictionary) is
//! used. If several columns fit, the first column whose first values can be read is chosen. A unit that does not fit
//! the role is an error.

use super::CsvOptions;
use super::column_name::ColumnName;
use super::dictionary::{Format, Known, Role, known, unknown_unit};
use super::state::direction;
use super::time_text::TimeText;
use crate::can::decode::{Channel, SensorIndex};
use crate::io::plausible;
use crate::io::table::{FirstRows, Header, PART_COLUMNS, TableError, parse_field};
use crate::io::units::{Quantity, Unit};
use crate::quantity::CellIndex;

#[derive(Debug, Clone, Copy)]
pub(super) struct Column {
    pub(super) index: usize,
    pub(super) unit: &'static Unit,
    pub(super) is_stated: bool,
}

#[derive(Debug)]
pub(super) struct Layout {
    pub(super) format: Format,
    pub(super) time: Column,
    pub(super) is_step_time: bool,
    pub(super) channels: Vec<(Channel, Column)>,
    pub(super) state: Option<usize>,
    /// Column of the charge taken out, and the factor by which its values are multiplied: -1 if the column contains
    /// charged minus discharged, otherwise 1.
    pub(super) discharged: Option<(Column, f64)>,
    pub(super) section: Option<usize>,
    pub(super) is_section_named: bool,
    pub(super) notes: Vec<String>,
}

impl Layout {
    pub(super) fn find(first: &FirstRows, options: &CsvOptions) -> Result<Self, TableError> {
        let mut columns = Columns::new(&first.header, options);
        columns.keep_readable(first);
        columns.layout()
    }

    pub(super) fn current(&self) -> Option<Column> {
        self.channels.iter().find(|(channel, _)| *channel == Channel::Current).map(|of| of.1)
    }
}

struct Columns<'a> {
    header: &'a Header,
    options: &'a CsvOptions,
    format: Format,
    known: Vec<(usize, Known)>,
}

impl<'a> Columns<'a> {
    fn new(header: &'a Header, options: &'a CsvOptions) -> Self {
        let roles = |(index, name): (usize, &String)| {
            known(name, header.unit_text(index)).into_iter().map(move |known| (index, known)).collect::<Vec<_>>()
        };
        let mut known: Vec<(usize, Known)> = header.names().iter().enumerate().flat_map(roles).collect();
        let name = |index: usize| header.names()[index].trim();
        let is_bare_t = |index: usize, of: &Known| of.unit.is_none() && name(index).eq_ignore_ascii_case("t");
        let has_time = known.iter().any(|(index, of)| group(of.role) == Role::Date && !is_bare_t(*index, of));
        // If the table has another column of time, `T` is a temperature and `t` is not used. Otherwise, both are
        // times.
        let is_meant = |index: usize, of: &Known| match of.role {
            Role::Temperature => has_time && name(index) == "T",
            _ => !has_time,
        };
        known.retain(|(index, of)| !is_bare_t(*index, of) || is_meant(*index, of));
        // In BioLogic's exports, `Ewe` is the potential of one electrode, and `Ecell` is the voltage of the cell.
        let is = |index: usize, words: &str| ColumnName::parse(name(index), "").words == words;
        let has_ecell = known.iter().any(|(index, _)| is(*index, "ecell"));
        known.retain(|(index, _)| !has_ecell || !is(*index, "ewe"));
        Self { header, options, format: Format::of(header.names()), known }
    }

    /// Drops columns whose first values cannot be read, if another column of the same role can be read.
    fn keep_readable(&mut self, first: &FirstRows) {
        let readable: Vec<Role> =
            self.known.iter().filter(|(index, of)| is_readable(first, *index, of)).map(|of| group(of.1.role)).collect();
        self.known.retain(|(index, of)| !readable.contains(&group(of.role)) || is_readable(first, *index, of));
    }

    fn layout(&self) -> Result<Layout, TableError> {
        let (time, is_step_time) = self.time()?;
        let mut channels = vec![(Channel::Current, self.required("current", Role::Current, Quantity::Current)?)];
        self.temperatures(&mut channels)?;
        self.voltages(&mut channels)?;
        if self.options.reported_soc {
            channels.extend(self.best(Role::Soc).map(|of| (Channel::ReportedSoc, self.column(of))));
        }
        channels.sort_by_key(|&(channel, _)| channel);
        let discharged = self.best(Role::Discharged).map(|of| (self.column(of), 1.0));
        let net = || self.best(Role::NetCharged).map(|of| (self.column(of), -1.0));
        let (section, is_section_named) = self.section(is_step_time)?;
        Ok(Layout {
            format: self.format,
            time,
            is_step_time,
            channels,
            state: self.state()?,
            discharged: discharged.or_else(net).filter(|(column, _)| column.is_stated),
            section,
            is_section_named,
            notes: self.left_out(),
        })
    }

    /// Notes on temperature columns with an unknown unit.
    fn left_out(&self) -> Vec<String> {
        let unknown = self.unknown_units().filter(|(_, role, _)| *role == Role::Temperature);
        unknown
            .map(|(name, _, unit)| format!("column {name} is left out, because its unit {unit:?} is unknown"))
            .collect()
    }

    fn unknown_units(&self) -> impl Iterator<Item = (&'a String, Role, String)> {
        let unit = |index: usize| self.header.unit_text(index);
        let names = self.header.names().iter().enumerate();
        let unread = names.filter(|(index, _)| !self.known.iter().any(|(of, _)| of == index));
        unread.filter_map(move |(index, name)| unknown_unit(name, unit(index)).map(|(role, unit)| (name, role, unit)))
    }

    fn mapped(&self, role: &str) -> Option<&'a str> {
        self.options.columns.iter().rev().find(|(r, _)| r == role).map(|(_, column)| column.as_str())
    }

    /// The column that the user names. The user may append a unit in brackets, which is not part of the name in the
    /// file.
    fn named(&self, role: &str, name: &str, quantity: Option<Quantity>) -> Result<Column, TableError> {
        let stated = name.strip_suffix(']').and_then(|rest| rest.rsplit_once('['));
        let exact = self.header.find(name).map(|index| (index, None));
        let with_unit = || {
            let (bare, unit) = stated?;
            Some((self.header.find(bare.trim_end())?, Some(unit)))
        };
        let (index, unit_text) = exact.or_else(with_unit).ok_or_else(|| self.missing(role, name))?;
        let base = quantity.map_or_else(|| Unit::base(Quantity::Share), Unit::base);
        let Some(quantity) = quantity else { return Ok(Column { index, unit: base, is_stated: false }) };
        let unit = match unit_text {
            Some(text) => Some(
                Unit::find(text)
                    .ok_or_else(|| self.header.fault(format_args!("--column {role}={name}: unknown unit {text:?}")))?,
            ),
            None => self.unit_of(index),
        };
        if let Some(unit) = unit.filter(|unit| unit.quantity != quantity) {
            let (name, symbol) = (&self.header.names()[index], unit.symbol);
            return Err(self.header.fault(format_args!("column {name} is in {symbol}, so it cannot be the {role}")));
        }
        Ok(Column { index, unit: unit.unwrap_or(base), is_stated: unit.is_some() })
    }

    /// The unit that the name of a column states, even if the name itself is unknown.
    fn unit_of(&self, index: usize) -> Option<&'static Unit> {
        let name = ColumnName::parse(&self.header.names()[index], self.header.unit_text(index));
        let of_role = self.known.iter().find(|(of, _)| *of == index).and_then(|(_, known)| known.unit);
        of_role
            .or(name.unit)
            .or_else(|| name.with_last_word_as_unit().filter(|of| of.words.len() > 1).and_then(|of| of.unit))
    }

    fn missing(&self, role: &str, name: &str) -> TableError {
        let is_wanted = |of: Role| of.quantity().is_some_and(|quantity| role.starts_with(quantity.name()));
        if let Some((name, _, unit)) = self.unknown_units().find(|(_, of, _)| is_wanted(*of)) {
            return self.header.fault(format_args!(
                "column {name}: unknown unit {unit:?}; write a known unit into the header, or use --column \
                 {role}='{name}[UNIT]'"
            ));
        }
        let what = if name.is_empty() { String::new() } else { format!(" {name}") };
        self.header.fault(format_args!(
            "no column{what} for {role}, found {}; name it with --column {role}=NAME, or {role}='NAME[UNIT]'",
            self.header.listed()
        ))
    }

    /// The columns of a role whose names are in the most preferred line of the dictionary, in the order of the file.
    fn best_all(&self, role: Role) -> Vec<(usize, Known)> {
        let of_role = || self.known.iter().filter(|(_, known)| known.role == role);
        let best = of_role().map(|(_, known)| known.rank).min();
        of_role().filter(|(_, known)| Some(known.rank) == best).copied().collect()
    }

    fn best(&self, role: Role) -> Option<(usize, Known)> {
        self.best_all(role).into_iter().next()
    }

    fn column(&self, (index, known): (usize, Known)) -> Column {
        let base = Unit::base(known.role.quantity().unwrap_or(Quantity::Share));
        Column { index, unit: known.unit.unwrap_or(base), is_stated: known.unit.is_some() }
    }

    fn required(&self, name: &str, role: Role, quantity: Quantity) -> Result<Column, TableError> {
        match self.mapped(name) {
            Some(column) => self.named(name, column, Some(quantity)),
            None => self.best(role).map(|of| self.column(of)).ok_or_else(|| self.missing(name, "")),
        }
    }

    /// The column of time, and whether its time restarts at each step of the test. In Neware's exports, `Time` counts
    /// from the start of the step.
    fn time(&self) -> Result<(Column, bool), TableError> {
        if let Some(column) = self.mapped("time") {
            return Ok((self.named("time", column, Some(Quantity::Time))?, false));
        }
        let total = self.best(Role::Time);
        let is_step = |(index, _): &(usize, Known)| {
            self.format == Format::Neware && ColumnName::parse(&self.header.names()[*index], "").words == "time"
        };
        let found = total.filter(|of| !is_step(of)).or_else(|| self.best(Role::Date)).map(|of| (of, false));
        let found = found.or_else(|| self.best(Role::StepTime).or(total).map(|of| (of, true)));
        found.map(|(of, is_step)| (self.column(of), is_step)).ok_or_else(|| self.missing("time", ""))
    }

    fn state(&self) -> Result<Option<usize>, TableError> {
        match self.mapped("state") {
            Some("") => Ok(None),
            Some(column) => self.named("state", column, None).map(|column| Some(column.index)),
            None => Ok(self.best(Role::State).map(|(index, _)| index)),
        }
    }

    /// The section column, and whether the user names it. Time restarts at each new value of this column.
    fn section(&self, is_step_time: bool) -> Result<(Option<usize>, bool), TableError> {
        match self.mapped("section") {
            Some("") => Ok((None, true)),
            Some(column) => self.named("section", column, None).map(|column| (Some(column.index), true)),
            None if is_step_time => Ok((self.best(Role::Step).map(|(index, _)| index), false)),
            None if matches!(self.format, Format::Packwatch | Format::Unknown) => {
                Ok((self.header.find_any(&PART_COLUMNS), false))
            }
            None => Ok((None, false)),
        }
    }

    /// The columns of numbered sensors or cells that the user names by a pattern, up to the first missing number.
    fn numbered(&self, role: &str, pattern: &str, quantity: Quantity, most: u16) -> Result<Vec<Column>, TableError> {
        let mut columns = Vec::new();
        for n in 0..most {
            match self.named(role, &pattern.replace("{n}", &(u32::from(n) + 1).to_string()), Some(quantity)) {
                Ok(column) => columns.push(column),
                Err(error) if n == 0 => return Err(error),
                Err(_) => break,
            }
        }
        Ok(columns)
    }

    fn temperatures(&self, channels: &mut Vec<(Channel, Column)>) -> Result<(), TableError> {
        let sensors = |columns: Vec<Column>| {
            columns.into_iter().zip(0..).map(|(column, n)| (Channel::Temperature(SensorIndex(n)), column))
        };
        if let Some(pattern) = self.mapped("temperature{n}") {
            let columns = self.numbered("temperature{n}", pattern, Quantity::Temperature, u16::MAX)?;
            channels.extend(sensors(columns));
            return Ok(());
        }
        match self.mapped("temperature") {
            Some("") => {}
            Some(column) => {
                channels.extend(sensors(vec![self.named("temperature", column, Some(Quantity::Temperature))?]))
            }
            None => {
                let mut best = self.best_all(Role::Temperature);
                // If a sensor has two columns with different units, only one of them is used.
                let mut numbers = Vec::new();
                best.retain(|(_, known)| {
                    let is_new = !numbers.contains(&known.number);
                    numbers.push(known.number);
                    is_new
                });
                best.sort_by_key(|(_, known)| known.number);
                best.truncate(usize::from(self.options.sensors.max(1)));
                channels.extend(sensors(best.into_iter().map(|of| self.column(of)).collect()));
            }
        }
        Ok(())
    }

    fn voltages(&self, channels: &mut Vec<(Channel, Column)>) -> Result<(), TableError> {
        let cells = self.options.cells;
        let cell = |columns: Vec<Column>| {
            columns.into_iter().zip(0..).map(|(column, n)| (Channel::CellVoltage(CellIndex(n)), column))
        };
        if let Some(pattern) = self.mapped("voltage{n}").filter(|_| !self.options.pack_total) {
            let columns = self.numbered("voltage{n}", pattern, Quantity::Voltage, cells)?;
            if columns.len() < usize::from(cells) {
                return Err(self.missing("voltage{n}", &pattern.replace("{n}", &(columns.len() + 1).to_string())));
            }
            channels.extend(cell(columns));
            return Ok(());
        }
        if self.options.pack_total {
            // The dictionary lists names of the pack's voltage after names of the cell's voltage.
            let best = self.known.iter().filter(|of| of.1.role == Role::Voltage).map(|of| of.1.rank).max();
            let named = self.known.iter().find(|of| of.1.role == Role::Voltage && Some(of.1.rank) == best);
            let column = match (self.mapped("voltage"), named) {
                (None, Some(&named)) => self.column(named),
                _ => self.required("voltage", Role::Voltage, Quantity::Voltage)?,
            };
            channels.push((Channel::PackVoltage, column));
            return Ok(());
        }
        let single = if self.mapped("voltage").is_some() { None } else { self.best(Role::Voltage) };
        if cells == 1 && (single.is_some() || self.mapped("voltage").is_some()) {
            channels.extend(cell(vec![self.required("voltage", Role::Voltage, Quantity::Voltage)?]));
            return Ok(());
        }
        channels.extend(cell(self.cell_columns()?));
        Ok(())
    }

    /// The columns of the cell voltages, numbered from 0 or from 1. The number of columns must equal the number of
    /// cells in the configuration.
    fn cell_columns(&self) -> Result<Vec<Column>, TableError> {
        let cells = usize::from(self.options.cells);
        let mut found: Vec<(usize, Known)> =
            self.known.iter().filter(|of| of.1.role == Role::CellVoltage).copied().collect();
        found.sort_by_key(|(index, known)| (known.number, *index));
        found.dedup_by_key(|(_, known)| known.number);
        let first = found.first().and_then(|(_, known)| known.number).unwrap_or(1);
        let is_sequence = found.iter().zip(first..).all(|((_, known), n)| known.number == Some(n));
        if found.len() != cells || first > 1 || !is_sequence {
            let role = if cells == 1 { "voltage" } else { "voltage{n}" };
            return Err(match found.len() {
                0 => self.missing(role, ""),
                count => self.header.fault(format_args!(
                    "{count} columns of cell voltages, must be {cells} as in the configuration, numbered from 0 or 1; \
                     found {}; name them with --column {role}=NAME",
                    self.header.listed()
                )),
            });
        }
        let unit = self.format.cell_voltage_unit();
        Ok(found
            .into_iter()
            .map(|of| {
                let column = self.column(of);
                match unit.filter(|_| !column.is_stated) {
                    Some(unit) => Column { unit, is_stated: true, ..column },
                    None => column,
                }
            })
            .collect())
    }
}

/// Maps the roles time and date to one role, because either column gives the time. Of the columns with this common
/// role, the readable ones are preferred.
fn group(role: Role) -> Role {
    if role == Role::Time { Role::Date } else { role }
}

/// Whether the first values of a column can be read as values of its role.
fn is_readable(first: &FirstRows, index: usize, known: &Known) -> bool {
    const JUDGED_ROWS: usize = 200;
    let rows = || first.rows().take(JUDGED_ROWS);
    let is_half = |read: usize, of: usize| read > 0 && 2 * read >= of;
    match known.role {
        Role::Time | Role::Date => {
            let mut reader = TimeText::new(known.unit.unwrap_or(Unit::base(Quantity::Time)));
            let texts: Vec<_> = rows().map(|row| row.text(index)).collect();
            reader.is_day_first = TimeText::is_day_first(&texts).0;
            // Any number is accepted, because the unit may be unknown. Only the order of the times is checked.
            let number = |text: &str| {
                parse_field(text.as_bytes()).flatten().or_else(|| Some(reader.parse(text.as_bytes())?.secs()))
            };
            let times: Vec<f64> = texts.iter().map(|text| text.trim()).filter_map(number).collect();
            is_half(times.len(), texts.len()) && plausible::check_order(&times).is_ok()
        }
        Role::State => rows().any(|row| row.bytes(index).and_then(direction).is_some()),
        Role::Step | Role::StepTime | Role::CellVoltage => true,
        Role::Temperature if known.number.is_some() => true,
        _ => {
            let texts: Vec<_> = rows().map(|row| row.parsed(index)).filter(|of| *of != Some(None)).collect();
            is_half(texts.iter().flatten().count(), texts.len())
        }
    }
}
