//! What the daemon sends, laid out by a DBC; and input frames made from values (CSV replay, simulator).
