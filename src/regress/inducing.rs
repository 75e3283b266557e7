//! Stub.
use super::Fault;
use super::model::Jitter;
use super::nearest::Data;
use super::plan::Plan;
#[derive(Debug, Clone)]
pub(super) struct Posterior {
    pub data: Data,
    pub value: f64,
    pub jitter: Jitter,
    points: Vec<f64>,
}
pub(super) fn choose(_: &Data, _: &[f64], _: usize, _: u64) -> Vec<f64> {
    vec![]
}
impl Posterior {
    pub fn new(_: &Data, _: &Plan, _: &[f64], _: &[f64]) -> Result<Self, Fault> {
        Err(Fault::Saved("to do".to_owned()))
    }
    pub fn gradient(&self) -> Vec<f64> {
        vec![]
    }
    pub fn predict(&self, _: &[f64]) -> Vec<(f64, f64)> {
        vec![]
    }
    pub fn left_out(&self, _: &[u32]) -> Vec<(f64, f64)> {
        vec![]
    }
    pub fn points(&self) -> &[f64] {
        &self.points
    }
}
