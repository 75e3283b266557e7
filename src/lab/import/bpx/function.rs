//! Defines a parameter of a BPX file that may depend on a variable: a number, an expression of `x`, or a table.

use serde_json::Value;

use super::expression::Expression;

/// Maximum number of points of a table. Measured potentials have a few thousand.
const MAX_POINTS: usize = 100_000;

/// A fault: path below the JSON value (empty, or starting with a dot), and text with what was found and what is
/// allowed.
type Fault = (String, String);

#[derive(Debug, Clone)]
pub(super) enum Function {
    Constant(f64),
    Expression(Expression),
    /// Points with rising `x`. Between and outside the points, values are interpolated and extrapolated linearly, as in
    /// PyBaMM.
    Table(Vec<(f64, f64)>),
}

impl Function {
    /// Reads a JSON value.
    ///
    /// # Errors
    /// The value is not a valid parameter. Each fault has its path below the value.
    pub(super) fn read(value: &Value) -> Result<Self, Vec<Fault>> {
        let fault = |text: String| vec![(String::new(), text)];
        match value {
            Value::Number(number) => {
                let number = number.as_f64().filter(|number| number.is_finite());
                number.map(Self::Constant).ok_or_else(|| fault(format!("{value}, must be a finite number")))
            }
            Value::String(text) => Expression::parse(text).map(Self::Expression).map_err(fault),
            Value::Object(_) => table(value).map(Self::Table),
            other => Err(fault(format!("{}, must be a number, an expression or a table {{x, y}}", found(other)))),
        }
    }

    pub(super) fn at(&self, x: f64) -> f64 {
        match self {
            Self::Constant(value) => *value,
            Self::Expression(expression) => expression.at(x),
            Self::Table(points) => {
                let k = points.partition_point(|point| point.0 <= x).clamp(1, points.len() - 1);
                let [(x0, y0), (x1, y1)] = [points[k - 1], points[k]];
                y0 + (x - x0) / (x1 - x0) * (y1 - y0)
            }
        }
    }

    /// Returns the slope at `x`, computed between `x - h` and `x + h`.
    pub(super) fn slope(&self, x: f64, h: f64) -> f64 {
        (self.at(x + h) - self.at(x - h)) / (2.0 * h)
    }
}

pub(super) fn found(value: &Value) -> String {
    match value {
        Value::Null => "null".to_owned(),
        Value::Array(values) => format!("a list of {}", values.len()),
        Value::Object(_) => "an object".to_owned(),
        other => other.to_string().chars().take(60).collect(),
    }
}

fn table(value: &Value) -> Result<Vec<(f64, f64)>, Vec<Fault>> {
    let (x, y) = match (numbers(value, "x"), numbers(value, "y")) {
        (Ok(x), Ok(y)) => (x, y),
        (x, y) => return Err([x.err(), y.err()].into_iter().flatten().collect()),
    };
    if x.len() != y.len() {
        return Err(vec![(".y".to_owned(), format!("{} values, must be {}, one per x", y.len(), x.len()))]);
    }
    if !(2..=MAX_POINTS).contains(&x.len()) {
        return Err(vec![(".x".to_owned(), format!("{} values, must be 2 to {MAX_POINTS}", x.len()))]);
    }
    let mut points: Vec<(f64, f64)> = x.into_iter().zip(y).collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    match points.windows(2).find(|pair| pair[0].0 >= pair[1].0) {
        Some(pair) => Err(vec![(".x".to_owned(), format!("{} twice, must differ", pair[0].0))]),
        None => Ok(points),
    }
}

fn numbers(table: &Value, key: &str) -> Result<Vec<f64>, Fault> {
    let list = table.get(key).and_then(Value::as_array);
    let list = list.ok_or_else(|| (format!(".{key}"), "missing, must be a list of numbers".to_owned()))?;
    let number = |(k, value): (usize, &Value)| {
        let number = value.as_f64().filter(|number| number.is_finite());
        number.ok_or_else(|| (format!(".{key}[{k}]"), format!("{}, must be a finite number", found(value))))
    };
    list.iter().enumerate().map(number).collect()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn table_is_sorted_and_linear_everywhere() {
        let table = Function::read(&json!({"x": [1, 0, 3], "y": [10, 0, 30]})).unwrap();
        for x in [-1.0, 0.0, 0.5, 1.0, 2.0, 4.0] {
            assert!((table.at(x) - 10.0 * x).abs() < 1e-12, "{x}");
        }
        assert!((table.slope(1.0, 0.1) - 10.0).abs() < 1e-9);
    }

    #[test]
    fn faults_have_a_path() {
        for (value, path, text) in [
            (json!({"x": [0, 1], "y": [0, 1, 2]}), ".y", "3 values, must be 2, one per x"),
            (json!({"x": [0, "a"], "y": [0, 1]}), ".x[1]", "\"a\", must be a finite number"),
            (json!({"x": [1, 1], "y": [0, 1]}), ".x", "1 twice, must differ"),
            (json!({"x": [1], "y": [0]}), ".x", "1 values, must be 2 to"),
            (json!({"x": [1, 2]}), ".y", "missing, must be a list"),
            (json!(null), "", "null, must be a number, an expression"),
            (json!("1 +"), "", "column 4: the end"),
        ] {
            let faults = Function::read(&value).unwrap_err();
            assert_eq!(faults.len(), 1);
            assert!(faults[0].0 == path && faults[0].1.starts_with(text), "{faults:?}");
        }
    }
}
