//! DBC text to messages and signals.
