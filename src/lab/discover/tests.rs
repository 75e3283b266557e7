//! Own logs.
