//! The demo's table: one row per cycle, and on a terminal a live row below them, redrawn in place.

use std::io::{self, IsTerminal, Write};
use std::time::Duration;

use crate::alarm::Rule;
use crate::cli::output::word;
use crate::quantity::Mode;

/// Pause after each redraw, so that a reader can follow.
const FRAME_TIME: Duration = Duration::from_millis(20);

/// Erases the line.
const ERASE_LINE: &str = "\r\x1b[K";

/// Values of a row.
pub(super) struct TableRow {
    pub(super) cycle: u32,
    pub(super) hours: f64,
    pub(super) mode: Mode,
    /// Estimate and its standard deviation, fraction.
    pub(super) soc: Option<(f64, f64)>,
    pub(super) true_soc: f64,
    /// Estimate and its standard deviation, Ah.
    pub(super) capacity_ah: (f64, f64),
    pub(super) true_capacity_ah: f64,
    pub(super) soh: f64,
    pub(super) recharge_period_s: Option<f64>,
    pub(super) alarms: Vec<Rule>,
}

/// Writes rows to standard output.
pub(super) struct Table {
    live: bool,
    has_head: bool,
}

const HEAD: [&str; 2] = [
    "              |        SOC, %         |       capacity, Ah       |  SOH | recharge |",
    "cycle    time |   est. +-  std   true |     est. +-   std   true |    % | period s | mode       alarms",
];

impl Table {
    pub(super) fn new() -> Self {
        Self { live: io::stdout().is_terminal(), has_head: false }
    }

    /// A row that stays.
    pub(super) fn keep(&mut self, row: &TableRow) -> io::Result<()> {
        self.head()?;
        let start = if self.live { ERASE_LINE } else { "" };
        writeln!(io::stdout(), "{start}{}", text(row))
    }

    /// The live row; nothing without a terminal.
    pub(super) fn redraw(&mut self, row: &TableRow) -> io::Result<()> {
        if !self.live {
            return Ok(());
        }
        self.head()?;
        write!(io::stdout(), "{ERASE_LINE}{}", text(row))?;
        io::stdout().flush()?;
        std::thread::sleep(FRAME_TIME);
        Ok(())
    }

    /// Removes the live row.
    pub(super) fn close(&self) -> io::Result<()> {
        if self.live { write!(io::stdout(), "{ERASE_LINE}") } else { Ok(()) }
    }

    fn head(&mut self) -> io::Result<()> {
        if !std::mem::replace(&mut self.has_head, true) {
            HEAD.iter().try_for_each(|line| writeln!(io::stdout(), "{line}"))?;
        }
        Ok(())
    }
}

fn text(row: &TableRow) -> String {
    let soc = match row.soc {
        Some((soc, std)) => format!("{:6.1} +-{:5.1}", 100.0 * soc, 100.0 * std),
        None => format!("{:>6}{:8}", "-", ""),
    };
    let recharge = row.recharge_period_s.map_or("-".to_owned(), |s| format!("{s:.0}"));
    let mode = word(row.mode);
    let alarms: Vec<String> = row.alarms.iter().map(|rule| rule.name().replace('_', " ")).collect();
    format!(
        "{:5} {:5.1} h | {soc} {:6.1} | {:8.3} +-{:6.3} {:6.3} | {:4.0} | {recharge:>8} | {mode:10} {}",
        row.cycle,
        row.hours,
        100.0 * row.true_soc,
        row.capacity_ah.0,
        row.capacity_ah.1,
        row.true_capacity_ah,
        100.0 * row.soh,
        alarms.join(", "),
    )
}
