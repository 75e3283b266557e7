//! Parses and evaluates expressions of one variable `x` as in BPX files. They follow a subset of Python's grammar but
//! are evaluated without Python.
//!
//! Input: a text with numbers, `x`, `+ - * / **`, signs, parentheses and the functions of [`FUNCTIONS`]. The text
//! becomes a program for a stack machine, which uses `libm`, so that the same text gives the same values on every
//! machine. As in Python, `**` is right-associative and binds more tightly than a sign before it (`-x**2` is
//! `-(x**2)`).

/// Maximum length of a text (bytes). The longest known expression of a potential has 500 bytes.
const MAX_BYTES: usize = 20_000;

/// Maximum nesting of parentheses, functions, signs and powers. Deeper nesting would exhaust the stack of the parser.
const MAX_DEPTH: usize = 64;

type Function = fn(f64) -> f64;

const FUNCTIONS: [(&str, Function); 13] = [
    ("exp", libm::exp),
    ("log", libm::log),
    ("log10", libm::log10),
    ("sqrt", libm::sqrt),
    ("sinh", libm::sinh),
    ("cosh", libm::cosh),
    ("tanh", libm::tanh),
    ("sin", libm::sin),
    ("cos", libm::cos),
    ("tan", libm::tan),
    ("arctan", libm::atan),
    ("atan", libm::atan),
    ("abs", libm::fabs),
];

#[derive(Debug, Clone, Copy)]
enum Step {
    Number(f64),
    X,
    Add,
    Subtract,
    Multiply,
    Divide,
    Power,
    Negate,
    Call(Function),
}

#[derive(Debug, Clone)]
pub(super) struct Expression(Vec<Step>);

impl Expression {
    /// Parses a text.
    ///
    /// # Errors
    /// The text is not a valid expression.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        if text.len() > MAX_BYTES {
            return Err(format!("has {} bytes, must be at most {MAX_BYTES}", text.len()));
        }
        let mut parser = Parser { text, at: 0, depth: 0, steps: Vec::new() };
        parser.sum()?;
        match parser.peek() {
            None => Ok(Self(parser.steps)),
            Some(_) => Err(parser.fault("an operator or the end")),
        }
    }

    /// Returns the value at `x`; it may be NaN or infinite.
    pub(super) fn at(&self, x: f64) -> f64 {
        let mut stack = Vec::with_capacity(16);
        for step in &self.0 {
            let value = match *step {
                Step::Number(value) => value,
                Step::X => x,
                Step::Negate => -pop(&mut stack),
                Step::Call(function) => function(pop(&mut stack)),
                operator => {
                    let (b, a) = (pop(&mut stack), pop(&mut stack));
                    binary(operator, a, b)
                }
            };
            stack.push(value);
        }
        pop(&mut stack)
    }
}

/// Removes and returns the topmost value. A parsed program never finds the stack empty.
fn pop(stack: &mut Vec<f64>) -> f64 {
    stack.pop().unwrap_or(f64::NAN)
}

fn binary(operator: Step, a: f64, b: f64) -> f64 {
    match operator {
        Step::Add => a + b,
        Step::Subtract => a - b,
        Step::Multiply => a * b,
        Step::Divide => a / b,
        Step::Power => libm::pow(a, b),
        Step::Number(_) | Step::X | Step::Negate | Step::Call(_) => f64::NAN,
    }
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
    depth: usize,
    steps: Vec<Step>,
}

impl Parser<'_> {
    fn rest(&self) -> &str {
        &self.text[self.at..]
    }

    fn peek(&mut self) -> Option<char> {
        self.at = self.text.len() - self.rest().trim_start().len();
        self.rest().chars().next()
    }

    /// If the text continues with `token`, consumes it and returns true.
    fn accept(&mut self, token: &str) -> bool {
        let is_next = self.peek().is_some() && self.rest().starts_with(token);
        if is_next {
            self.at += token.len();
        }
        is_next
    }

    fn fault(&mut self, allowed: &str) -> String {
        let found = self.peek().map_or_else(|| "the end".to_owned(), |_| format!("{:?}", self.word()));
        format!("column {}: {found}, must be {allowed}", self.text[..self.at].chars().count() + 1)
    }

    /// Returns the next name or, if there is none, the next character.
    fn word(&self) -> &str {
        let rest = self.rest();
        let is_name = |c: char| c.is_alphanumeric() || c == '_';
        let first = rest.chars().next().map_or(0, char::len_utf8);
        &rest[..rest.find(|c| !is_name(c)).unwrap_or(rest.len()).max(first)]
    }

    fn sum(&mut self) -> Result<(), String> {
        self.product()?;
        while let Some(sign @ ('+' | '-')) = self.peek() {
            self.at += 1;
            self.product()?;
            self.steps.push(if sign == '+' { Step::Add } else { Step::Subtract });
        }
        Ok(())
    }

    fn product(&mut self) -> Result<(), String> {
        self.signed()?;
        while let Some(sign @ ('*' | '/')) = self.peek() {
            self.at += 1;
            self.signed()?;
            self.steps.push(if sign == '*' { Step::Multiply } else { Step::Divide });
        }
        Ok(())
    }

    fn signed(&mut self) -> Result<(), String> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(self.fault(&format!("nested at most {MAX_DEPTH} deep")));
        }
        if self.accept("+") {
            self.signed()?;
        } else if self.accept("-") {
            self.signed()?;
            self.steps.push(Step::Negate);
        } else {
            self.atom()?;
            if self.accept("**") {
                self.signed()?;
                self.steps.push(Step::Power);
            }
        }
        self.depth -= 1;
        Ok(())
    }

    fn atom(&mut self) -> Result<(), String> {
        match self.peek() {
            Some('(') => self.parentheses(),
            Some(c) if c.is_ascii_digit() || c == '.' => self.number(),
            Some(c) if c.is_alphabetic() || c == '_' => self.name(),
            _ => Err(self.fault("a number, x, a function or a parenthesis")),
        }
    }

    fn parentheses(&mut self) -> Result<(), String> {
        if !self.accept("(") {
            return Err(self.fault("\"(\""));
        }
        self.sum()?;
        if self.accept(")") { Ok(()) } else { Err(self.fault("\")\" or an operator")) }
    }

    fn number(&mut self) -> Result<(), String> {
        let bytes = self.rest().as_bytes();
        let digits = |from: usize| bytes[from..].iter().take_while(|c| c.is_ascii_digit()).count();
        let mut end = digits(0);
        if bytes.get(end) == Some(&b'.') {
            end += 1 + digits(end + 1);
        }
        if matches!(bytes.get(end), Some(b'e' | b'E')) {
            let sign = usize::from(matches!(bytes.get(end + 1), Some(b'+' | b'-')));
            let exponent = digits(end + 1 + sign);
            end += if exponent > 0 { 1 + sign + exponent } else { 0 };
        }
        let value = self.rest()[..end].parse().ok().filter(|value: &f64| value.is_finite());
        let value = value.ok_or_else(|| self.fault("a finite number"))?;
        self.at += end;
        self.steps.push(Step::Number(value));
        Ok(())
    }

    fn name(&mut self) -> Result<(), String> {
        let name = self.word().to_owned();
        if name == "x" {
            self.at += name.len();
            self.steps.push(Step::X);
            return Ok(());
        }
        let Some((_, function)) = FUNCTIONS.iter().find(|(known, _)| *known == name) else {
            let known: Vec<&str> = FUNCTIONS.iter().map(|(name, _)| *name).collect();
            return Err(self.fault(&format!("x or one of {}", known.join(", "))));
        };
        self.at += name.len();
        self.parentheses()?;
        self.steps.push(Step::Call(*function));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &str, x: f64) -> f64 {
        Expression::parse(text).unwrap().at(x)
    }

    #[test]
    fn values_agree_with_python() {
        for (text, x, expected) in [
            ("-x**2", 3.0, -9.0),
            ("2**3**2", 0.0, 512.0),
            ("2**-1", 0.0, 0.5),
            ("1 - 2 - 3", 0.0, -4.0),
            ("8 / 2 / 2", 0.0, 2.0),
            ("2 * -x", 3.0, -6.0),
            ("+ - -x", 3.0, 3.0),
            ("1.5e-1 * (x + .5)", 1.5, 0.3),
            ("exp(0) + tanh(0.0) + sqrt(x)*2.", 4.0, 5.0),
            ("-3.04420906 * x + 10.04892207", 0.0, 10.048_922_07),
        ] {
            assert!((value(text, x) - expected).abs() < 1e-15, "{text}: {}", value(text, x));
        }
        assert!(value("log(x)", -1.0).is_nan());
    }

    #[test]
    fn fault_states_column_found_and_allowed() {
        for (text, place) in [
            ("1 + y", "column 5: \"y\", must be x or one of exp"),
            ("1 +", "column 4: the end, must be a number"),
            ("__import__('os')", "column 1: \"__import__\", must be x or one of"),
            ("(1 + x", "column 7: the end, must be \")\""),
            ("2 x", "column 3: \"x\", must be an operator"),
            ("x \u{e9}", "column 3: \"\u{e9}\", must be an operator"),
            ("exp x", "column 5: \"x\", must be \"(\""),
            ("1e999", "column 1: \"1e999\", must be a finite number"),
            ("", "column 1: the end"),
        ] {
            let fault = Expression::parse(text).unwrap_err();
            assert!(fault.starts_with(place), "{text}: {fault}");
        }
    }

    #[test]
    fn deep_nesting_is_rejected() {
        assert!(Expression::parse(&"(".repeat(10_000)).unwrap_err().contains("nested at most"));
        assert!(Expression::parse(&"-".repeat(10_000)).unwrap_err().contains("nested at most"));
        assert!(Expression::parse(&"x + ".repeat(10_000)).unwrap_err().contains("bytes"));
        let long = format!("{}x", "x + ".repeat(1000));
        assert!((value(&long, 2.0) - 2002.0).abs() < 1e-9);
    }

    proptest::proptest! {
        #[test]
        fn any_text_is_parsed_or_rejected(text in "[-+*/() x.0-9eyéx]{0,40}") {
            if let Ok(expression) = Expression::parse(&text) {
                let _ = expression.at(0.5);
            }
        }
    }
}
