//! The demo's table: one row per cycle and, on a terminal, a live row that is redrawn below the other rows.

use std::io::{self, IsTerminal, Write};
use std::time::Duration;

/// Escape sequence that erases the line.
const ERASE_LINE: &str = "\r\x1b[K";

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

    /// Writes a permanent row.
    pub(super) fn keep(&mut self, row: &str) -> io::Result<()> {
        self.head()?;
        let start = if self.live { ERASE_LINE } else { "" };
        writeln!(io::stdout(), "{start}{}", row)
    }

    /// Redraws the live row; does nothing if the output is not a terminal.
    pub(super) fn redraw(&mut self, row: &str) -> io::Result<()> {
        if !self.live {
            return Ok(());
        }
        self.head()?;
        write!(io::stdout(), "{ERASE_LINE}{}", row)?;
        io::stdout().flush()?;
        // The pause lets the user read the row.
        std::thread::sleep(Duration::from_millis(20));
        Ok(())
    }

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
