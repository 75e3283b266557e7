//! Parsers of number arguments; each error names the allowed values.

/// A finite number.
pub(crate) fn finite(text: &str) -> Result<f64, String> {
    within(text, |_| true, "a finite number")
}

/// A finite number that `is_allowed`; the error says `allowed`.
pub(crate) fn within(text: &str, is_allowed: impl Fn(f64) -> bool, allowed: &str) -> Result<f64, String> {
    let value = text.trim().parse::<f64>().ok().filter(|value| value.is_finite() && is_allowed(*value));
    value.ok_or_else(|| format!("must be {allowed}"))
}

/// A finite number above 0.
pub(crate) fn above_0(text: &str) -> Result<f64, String> {
    within(text, |value| value > 0.0, "a finite number above 0")
}

/// A number strictly between 0 and 1.
pub(crate) fn fraction(text: &str) -> Result<f64, String> {
    within(text, |value| value > 0.0 && value < 1.0, "above 0 and below 1")
}

/// A number from 0 to 1.
pub(crate) fn share(text: &str) -> Result<f64, String> {
    within(text, |value| (0.0..=1.0).contains(&value), "0 to 1")
}

/// Per cent above 0, at most 100; a per cent sign may follow.
pub(crate) fn percent(text: &str) -> Result<f64, String> {
    let digits = text.trim().trim_end_matches('%');
    within(digits, |value| value > 0.0 && value <= 100.0, "per cent above 0, at most 100")
}
