//! Measures the time of one estimator step. Also measures the time that the core takes, from input frames to output
//! frames, for one reading of each cell of a 96-cell pack.

use common::{example, reading};
use packwatch_host::can::encode::InputEncoder;
use packwatch_host::cell::{CellModel, EstimatorBank};
use packwatch_host::monitor::{Monitor, Outputs, Record};
use packwatch_host::quantity::{CellIndex, Channel, SensorIndex, Timestamp};

mod common;

/// Counts allocations, to show that a step allocates nothing.
#[global_allocator]
static ALLOCATOR: divan::AllocProfiler = divan::AllocProfiler::system();

fn main() {
    divan::main();
}

/// Returns the cell model of `config/example.toml`, with 1 to 3 equal RC branches.
fn model(branches: usize) -> CellModel {
    let mut model = example().monitor.model;
    model.branches = vec![model.branches[0].clone(); branches];
    model
}

#[divan::bench(args = [1, 2, 3])]
fn ukf_step(bencher: divan::Bencher, branches: usize) {
    let (model, config) = (model(branches), example().monitor.estimator);
    let mut bank = EstimatorBank::new(&model, &config, 1);
    let mut k = 0_u32;
    bencher.bench_local(|| {
        k = k.wrapping_add(1);
        bank.add(0, &reading(k, 0));
        bank.step();
        divan::black_box(*bank.result(0))
    });
}

#[divan::bench]
fn round_of_96_cells(bencher: divan::Bencher) {
    let config = example();
    let mut values = vec![(Channel::Current, Some(10.0))];
    values.extend((0..12).map(|sensor| (Channel::Temperature(SensorIndex(sensor)), Some(25.0))));
    values.extend((0..96).map(|cell| (Channel::CellVoltage(CellIndex(cell)), Some(3.7 + 0.0001 * f64::from(cell)))));
    let mut frames = Vec::new();
    InputEncoder::new(&config.monitor.input).encode(&values, &mut frames);
    let (mut monitor, mut out) = (Monitor::new(config.monitor), Outputs::default());
    let mut time = Timestamp::from_secs(1.7e9);
    bencher.counter(divan::counter::ItemsCount::new(96_u32)).bench_local(|| {
        time = time.plus_secs(0.1);
        for (bus, frame) in &frames {
            monitor.handle(&Record::frame(time, *bus, frame), &mut out);
        }
        monitor.handle(&Record::tick(time), &mut out);
        divan::black_box(&out);
        out.clear();
    });
}
