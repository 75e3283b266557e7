//! Implements a k-d tree, which finds the rows nearest to a point. The search may be limited to rows with numbers below
//! a given number.
//!
//! The caller checks that all inputs are finite.
//!
//! The distance is Euclidean after each input is multiplied by its weight. Of two rows at the same distance, the row
//! with the lower number is nearer, so that the result does not depend on the layout of the tree.

use std::collections::BinaryHeap;

/// A tree of rows. Rows are numbered from 0.
#[derive(Debug, Clone)]
pub(super) struct KdTree {
    weights: Vec<f64>,
    /// Weighted inputs. The rows are in the order of the leaves.
    points: Vec<f64>,
    numbers: Vec<u32>,
    nodes: Vec<TreeNode>,
}

#[derive(Debug, Clone)]
struct TreeNode {
    first: usize,
    end: usize,
    /// Lowest row number in the subtree of this node.
    minimum: u32,
    /// Axis, position of the cut, and index of the right child. The left child is the next node. `None` = the node is a
    /// leaf.
    cut: Option<(usize, f64, usize)>,
}

/// The nearest rows found. The top of the heap is the farthest of them.
struct NearestHeap {
    /// Bit pattern of the squared distance, and the row number. Bit patterns of non-negative floats sort like the
    /// floats.
    heap: BinaryHeap<(u64, u32)>,
    wanted: usize,
}

impl NearestHeap {
    fn worst(&self) -> f64 {
        let full = self.heap.peek().filter(|_| self.heap.len() == self.wanted);
        full.map_or(f64::INFINITY, |(bits, _)| f64::from_bits(*bits))
    }

    fn offer(&mut self, distance: f64, row: u32) {
        self.heap.push((distance.to_bits(), row));
        if self.heap.len() > self.wanted {
            self.heap.pop();
        }
    }
}

impl KdTree {
    pub(super) fn new(inputs: &[f64], weights: &[f64]) -> Self {
        let d = weights.len();
        let weighted: Vec<f64> = inputs.iter().enumerate().map(|(at, x)| x * weights[at % d]).collect();
        let mut numbers: Vec<u32> = (0..).take(inputs.len() / d).collect();
        let mut tree = Self { weights: weights.to_vec(), points: Vec::new(), numbers: Vec::new(), nodes: Vec::new() };
        tree.build(&weighted, &mut numbers, 0);
        tree.points = numbers.iter().flat_map(|row| weighted[*row as usize * d..][..d].to_vec()).collect();
        tree.numbers = numbers;
        tree
    }

    fn build(&mut self, points: &[f64], rows: &mut [u32], first: usize) {
        let d = self.weights.len();
        let of = |row: u32, axis: usize| points[row as usize * d + axis];
        let minimum = rows.iter().copied().min().unwrap_or(u32::MAX);
        let here = self.nodes.len();
        self.nodes.push(TreeNode { first, end: first + rows.len(), minimum, cut: None });
        let spread = |axis: usize| {
            let ends = (rows.iter()).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), row| {
                (low.min(of(*row, axis)), high.max(of(*row, axis)))
            });
            ends.1 - ends.0
        };
        let axis = (0..d).max_by(|a, b| spread(*a).total_cmp(&spread(*b))).unwrap_or(0);
        if rows.len() <= 16 || spread(axis) <= 0.0 {
            return;
        }
        let middle = rows.len() / 2;
        rows.select_nth_unstable_by(middle, |a, b| of(*a, axis).total_cmp(&of(*b, axis)).then(a.cmp(b)));
        let place = of(rows[middle], axis);
        let (left, right) = rows.split_at_mut(middle);
        self.build(points, left, first);
        let right_child = self.nodes.len();
        self.build(points, right, first + middle);
        self.nodes[here].cut = Some((axis, place, right_child));
    }

    /// Returns up to `wanted` rows, nearest first, whose numbers are below `before` and differ from `excluded`.
    pub(super) fn nearest(&self, point: &[f64], wanted: usize, before: usize, excluded: Option<usize>) -> Vec<u32> {
        let point: Vec<f64> = point.iter().zip(&self.weights).map(|(x, w)| x * w).collect();
        let before = u32::try_from(before).unwrap_or(u32::MAX);
        let excluded = excluded.and_then(|row| u32::try_from(row).ok());
        let mut found = NearestHeap { heap: BinaryHeap::with_capacity(wanted + 1), wanted };
        if wanted > 0 {
            self.visit(0, &point, before, excluded, &mut found);
        }
        found.heap.into_sorted_vec().into_iter().map(|(_, row)| row).collect()
    }

    fn visit(&self, at: usize, point: &[f64], before: u32, excluded: Option<u32>, found: &mut NearestHeap) {
        let node = &self.nodes[at];
        if node.minimum >= before {
            return;
        }
        let Some((axis, place, right)) = node.cut else {
            return self.search_leaf(node, point, before, excluded, found);
        };
        let away = point[axis] - place;
        let (near, far) = if away < 0.0 { (at + 1, right) } else { (right, at + 1) };
        self.visit(near, point, before, excluded, found);
        if away * away <= found.worst() {
            self.visit(far, point, before, excluded, found);
        }
    }

    fn search_leaf(&self, node: &TreeNode, point: &[f64], before: u32, excluded: Option<u32>, found: &mut NearestHeap) {
        let d = point.len();
        for place in node.first..node.end {
            let row = self.numbers[place];
            if row < before && Some(row) != excluded {
                let squares = self.points[place * d..][..d].iter().zip(point).map(|(a, b)| (a - b) * (a - b));
                found.offer(squares.sum(), row);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tree_agrees_with_exhaustive_search() {
        let mut state = 1_u64;
        let mut draw = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            // The coordinates have few different values, so that some distances and some rows are equal.
            f64::from((state >> 40) as u32 % 25)
        };
        let inputs: Vec<f64> = (0..3 * 700).map(|_| draw()).collect();
        let weights = [1.0, 0.3, 2.0];
        let tree = KdTree::new(&inputs, &weights);
        let square =
            |a: &[f64], b: &[f64]| -> f64 { (0..3).map(|k| (a[k] * weights[k] - b[k] * weights[k]).powi(2)).sum() };
        for (query, before) in [(3, 700), (500, 500), (20, 20), (699, 350), (0, 0)] {
            let point = &inputs[3 * query..][..3];
            let mut all: Vec<u32> = (0..before as u32).filter(|row| *row as usize != query).collect();
            all.sort_by(|a, b| {
                let of = |row: &u32| square(&inputs[*row as usize * 3..][..3], point);
                of(a).total_cmp(&of(b)).then(a.cmp(b))
            });
            all.truncate(30);
            assert_eq!(tree.nearest(point, 30, before, Some(query)), all);
        }
    }

    #[test]
    fn equal_rows_end_recursion() {
        let tree = KdTree::new(&[1.0; 5000], &[1.0]);
        assert_eq!(tree.nearest(&[1.0], 3, 5000, Some(1)), [0, 2, 3]);
    }
}
