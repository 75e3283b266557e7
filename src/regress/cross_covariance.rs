//! Evaluates the covariance function of a Gaussian process between many rows and one point, in blocks.
//!
//! Input: rows in column-major order, and the point. Output: squared differences and covariances. The caller checks the
//! inputs.

use super::plan::{Covariance, Work};

/// Number of pairs per block. The memory of a block fits into the first-level cache.
pub(super) const BLOCK_PAIRS: usize = 1024;

pub(super) fn by_column(inputs: &[f64], dimensions: usize) -> Vec<f64> {
    (0..dimensions).flat_map(|d| inputs.iter().skip(d).step_by(dimensions).copied()).collect()
}

impl Covariance {
    pub(super) fn cross(
        &self,
        columns: &[f64],
        first: usize,
        point: &[f64],
        scratch: &mut (Vec<f64>, Work),
        out: &mut [f64],
    ) {
        for (block, part) in out.chunks_mut(BLOCK_PAIRS).enumerate() {
            let count = part.len();
            squares(columns, first + block * BLOCK_PAIRS, count, point, &mut scratch.0);
            part.copy_from_slice(self.evaluate(&scratch.0, count, &mut scratch.1));
        }
    }
}

/// Writes the squared differences between the rows `from..from + count` and a point to `out`: first those of the first
/// input, then those of the second input, and so on.
pub(super) fn squares(columns: &[f64], from: usize, count: usize, point: &[f64], out: &mut Vec<f64>) {
    let n = columns.len() / point.len();
    out.resize(count * point.len(), 0.0);
    for (d, x) in point.iter().enumerate() {
        let column = &columns[d * n + from..][..count];
        out[d * count..][..count].iter_mut().zip(column).for_each(|(square, c)| *square = (c - x) * (c - x));
    }
}
