//! Defines covariance functions (kernels) as text and as a tree. Kernels are sums and products of five shapes.
//!
//! A kernel can be converted to text again. A parse error states the column in the text.
//!
//! In this table, r is the distance between two rows after each input is divided by its length scale:
//!
//! | name | k(r) |
//! | --- | --- |
//! | `exponential` | exp(-r) |
//! | `matern32` | (1 + sqrt(3) r) exp(-sqrt(3) r) |
//! | `matern52` | (1 + sqrt(5) r + 5 r^2 / 3) exp(-sqrt(5) r) |
//! | `squared_exponential` | exp(-r^2 / 2) |
//! | `rational_quadratic` | (1 + r^2 / (2 alpha))^-alpha |
//!
//! Operators have their usual precedence, as in `a + b * (c + d)`. A name may contain dashes instead of underscores.
//! Every shape has its own length scales. A shape also has its own standard deviation, unless it is the second or a
//! later factor of a product, because the standard deviations of several factors could not be distinguished. If such a
//! factor is a sum, only the first term of the sum has no standard deviation.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::error::RegressionError;

/// Maximum nesting depth of brackets. It limits the recursion of the parser.
const MAX_DEPTH: usize = 16;
/// Maximum number of shapes in one kernel. Each shape has its own parameters.
const MAX_SHAPES: usize = 16;

/// A covariance function that depends only on the distance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// Rough functions: an Ornstein-Uhlenbeck process.
    Exponential,
    /// Functions that are differentiable once.
    Matern32,
    /// Functions that are differentiable twice.
    Matern52,
    /// Functions that are differentiable infinitely often.
    SquaredExponential,
    /// A mixture of squared exponentials with different length scales.
    RationalQuadratic,
}

impl Shape {
    /// All shapes.
    pub const ALL: [Self; 5] =
        [Self::Exponential, Self::SquaredExponential, Self::Matern32, Self::Matern52, Self::RationalQuadratic];

    /// Returns the name of the shape in the text of a kernel.
    pub fn name(self) -> &'static str {
        match self {
            Self::Exponential => "exponential",
            Self::Matern32 => "matern32",
            Self::Matern52 => "matern52",
            Self::SquaredExponential => "squared_exponential",
            Self::RationalQuadratic => "rational_quadratic",
        }
    }
}

/// A covariance function: a tree of shapes, sums and products. `parse` creates it from text; `to_string` converts it
/// back.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Kernel {
    pub(super) root: Node,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Node {
    Leaf(Shape),
    Sum(Vec<Node>),
    Product(Vec<Node>),
}

impl From<Shape> for Kernel {
    fn from(shape: Shape) -> Self {
        Self { root: Node::Leaf(shape) }
    }
}

impl From<Kernel> for String {
    fn from(kernel: Kernel) -> Self {
        kernel.to_string()
    }
}

impl TryFrom<String> for Kernel {
    type Error = RegressionError;

    fn try_from(text: String) -> Result<Self, RegressionError> {
        text.parse()
    }
}

impl fmt::Display for Kernel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write_node(f, &self.root, false)
    }
}

fn write_node(f: &mut fmt::Formatter<'_>, node: &Node, in_product: bool) -> fmt::Result {
    let (children, sign) = match node {
        Node::Leaf(shape) => return f.write_str(shape.name()),
        Node::Sum(children) => (children, " + "),
        Node::Product(children) => (children, " * "),
    };
    let brackets = in_product && matches!(node, Node::Sum(_));
    f.write_str(if brackets { "(" } else { "" })?;
    for (k, child) in children.iter().enumerate() {
        f.write_str(if k > 0 { sign } else { "" })?;
        write_node(f, child, matches!(node, Node::Product(_)))?;
    }
    f.write_str(if brackets { ")" } else { "" })
}

impl FromStr for Kernel {
    type Err = RegressionError;

    fn from_str(text: &str) -> Result<Self, RegressionError> {
        let mut parser = KernelParser { text, rest: text, depth: 0, shapes: 0 };
        let root = parser.sum()?;
        match parser.rest.trim_start() {
            "" => Ok(Self { root }),
            rest => Err(parser.fault(rest, "+, * or the end")),
        }
    }
}

struct KernelParser<'a> {
    text: &'a str,
    rest: &'a str,
    depth: usize,
    shapes: usize,
}

impl KernelParser<'_> {
    fn sum(&mut self) -> Result<Node, RegressionError> {
        let mut terms = vec![self.product()?];
        while self.take('+') {
            terms.push(self.product()?);
        }
        Ok(if terms.len() == 1 { terms.remove(0) } else { Node::Sum(flat(terms, true)) })
    }

    fn product(&mut self) -> Result<Node, RegressionError> {
        let mut factors = vec![self.atom()?];
        while self.take('*') {
            factors.push(self.atom()?);
        }
        Ok(if factors.len() == 1 { factors.remove(0) } else { Node::Product(flat(factors, false)) })
    }

    fn atom(&mut self) -> Result<Node, RegressionError> {
        if self.take('(') {
            self.depth += 1;
            if self.depth > MAX_DEPTH {
                return Err(self.fault(self.rest, &format!("at most {MAX_DEPTH} brackets open at once")));
            }
            let inside = self.sum()?;
            if !self.take(')') {
                return Err(self.fault(self.rest, "+, * or )"));
            }
            self.depth -= 1;
            return Ok(inside);
        }
        let start = self.rest.trim_start();
        let word = start.split(|c: char| !c.is_ascii_alphanumeric() && c != '_' && c != '-').next().unwrap_or("");
        // Kernels have no minus sign, so a dash in a name is not ambiguous.
        let name = word.replace('-', "_");
        let Some(shape) = Shape::ALL.into_iter().find(|shape| shape.name() == name) else {
            let names: Vec<&str> = Shape::ALL.iter().map(|shape| shape.name()).collect();
            return Err(self.fault(start, &names.join(", ")));
        };
        self.shapes += 1;
        if self.shapes > MAX_SHAPES {
            return Err(self.fault(start, &format!("at most {MAX_SHAPES} shapes in one kernel")));
        }
        self.rest = &start[word.len()..];
        Ok(Node::Leaf(shape))
    }

    fn take(&mut self, sign: char) -> bool {
        let rest = self.rest.trim_start().strip_prefix(sign);
        self.rest = rest.unwrap_or(self.rest);
        rest.is_some()
    }

    fn fault(&self, at: &str, allowed: &str) -> RegressionError {
        let column = self.text[..self.text.len() - at.trim_start().len()].chars().count() + 1;
        let found = at.split_whitespace().next().unwrap_or("the end").to_owned();
        RegressionError::Kernel { text: self.text.to_owned(), column, found, allowed: allowed.to_owned() }
    }
}

/// Replaces nested sums by their terms and nested products by their factors.
fn flat(nodes: Vec<Node>, is_sum: bool) -> Vec<Node> {
    let mut all = Vec::new();
    for node in nodes {
        match node {
            Node::Sum(inside) if is_sum => all.extend(inside),
            Node::Product(inside) if !is_sum => all.extend(inside),
            other => all.push(other),
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernel_text_round_trips() {
        for (text, written) in [
            ("exponential", "exponential"),
            (
                " matern32+squared_exponential*rational_quadratic ",
                "matern32 + squared_exponential * rational_quadratic",
            ),
            ("(matern32 + matern52) * exponential", "(matern32 + matern52) * exponential"),
            ("((matern32)) + (exponential + matern52)", "matern32 + exponential + matern52"),
            ("squared-exponential*rational-quadratic", "squared_exponential * rational_quadratic"),
        ] {
            let kernel: Kernel = text.parse().expect(text);
            assert_eq!(kernel.to_string(), written);
            assert_eq!(kernel.to_string().parse::<Kernel>().expect(written), kernel);
        }
    }

    #[test]
    fn invalid_kernel_text_is_rejected_with_column() {
        for (text, column, found) in [
            ("", 1, "the end"),
            ("gaussian", 1, "gaussian"),
            ("exponential matern32", 13, "matern32"),
            ("exponential + ", 15, "the end"),
            ("exponential * (matern32", 24, "the end"),
            ("é", 1, "é"),
        ] {
            let fault = text.parse::<Kernel>().expect_err(text);
            assert!(
                matches!(&fault, RegressionError::Kernel { column: c, found: f, .. } if *c == column && f == found),
                "{text:?}: {fault}"
            );
        }
        assert!("(".repeat(100_000).parse::<Kernel>().is_err());
        assert!(vec!["matern32"; 17].join("+").parse::<Kernel>().is_err());
    }
}
