//! The failure of a command: the message for the terminal and the exit code. Every program of packwatch uses this type.

use crate::config::ConfigFaults;

/// Exit code of a bad configuration (EX_CONFIG). The service files tell systemd not to restart a service after this
/// code.
pub const EXIT_CONFIG: u8 = 78;

/// Why a command failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// Message for the terminal, without the program's name; empty = the output already reports the failure.
    pub message: String,
    /// Exit code.
    pub code: u8,
}

impl Failure {
    /// Creates a failure of the work itself, with exit code 1.
    pub fn new(message: impl Into<String>) -> Self {
        Self { message: message.into(), code: 1 }
    }

    /// Creates a failure that a restart does not fix, with exit code 78.
    pub fn config(message: impl Into<String>) -> Self {
        Self { message: message.into(), code: EXIT_CONFIG }
    }
}

impl From<ConfigFaults> for Failure {
    fn from(faults: ConfigFaults) -> Self {
        Self::config(faults.to_string())
    }
}
