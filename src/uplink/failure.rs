//! Why a command ended without success: what to print and the exit code, as of `packwatch`.

/// Exit code of bad settings (EX_CONFIG; systemd does not restart on it).
const EXIT_CONFIG: u8 = 78;

/// Why a command ended without success.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    /// For the terminal.
    pub message: String,
    /// Exit code.
    pub code: u8,
}

impl Failure {
    /// A failure of the work itself: exit code 1.
    pub fn new(message: impl Into<String>) -> Self {
        Self { message: message.into(), code: 1 }
    }

    /// A failure that another start does not repair: exit code 78.
    pub fn config(message: impl Into<String>) -> Self {
        Self { message: message.into(), code: EXIT_CONFIG }
    }
}
