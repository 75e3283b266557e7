//! Colours and words shared by all parts of the live view.

use ratatui::style::{Color, Modifier, Style};

use crate::alarm::Severity;
use crate::io::stamp;
use crate::monitor::Validity;
use crate::quantity::Timestamp;

/// Colours of the view. Without colour, the view uses only attributes of the text, such as bold and reversed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Theme {
    pub(super) has_colour: bool,
}

impl Theme {
    pub(super) fn colour(self, colour: Color) -> Style {
        if self.has_colour { Style::new().fg(colour) } else { Style::new() }
    }

    pub(super) fn severity(self, severity: Severity) -> Style {
        match severity {
            Severity::Info => self.colour(Color::Cyan),
            Severity::Warning => self.colour(Color::Yellow).add_modifier(Modifier::BOLD),
            Severity::Severe => self.colour(Color::Red).add_modifier(Modifier::BOLD | Modifier::REVERSED),
        }
    }

    pub(super) fn validity(self, validity: Validity) -> Style {
        match validity {
            Validity::Valid => self.colour(Color::Green),
            Validity::Degraded => self.colour(Color::Yellow).add_modifier(Modifier::BOLD),
            Validity::Untrusted | Validity::Unavailable => self.colour(Color::Red).add_modifier(Modifier::BOLD),
        }
    }
}

/// Formats the time of day, UTC.
pub(super) fn clock(time: Timestamp) -> String {
    let stamp = stamp::format_utc(time);
    stamp.split_once('T').map_or(stamp.clone(), |(_, clock)| clock.to_owned())
}
