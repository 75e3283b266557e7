//! Runs a simulated cell through the whole core, with the ticks of a replay.

use packwatch::can::encode::InputEncoder;
use packwatch::io::ticks::Ticks;
use packwatch::monitor::{Event, Monitor, MonitorConfig, Outputs, Record, TICK_PERIOD_MS};
use packwatch::quantity::Timestamp;
use packwatch::sim::{Simulation, Wiring};

/// Sleep gap (s). These simulations have no such gap.
const SLEEP_GAP_S: f64 = 30.0;

/// Runs `settings` to the end. Calls `each` after each step.
pub(crate) fn live(
    config: MonitorConfig,
    settings: packwatch::sim::Settings,
    mut each: impl FnMut(Timestamp, &Simulation, &Monitor, &[Event]),
) {
    let mut sim = Simulation::new(config.model.clone(), settings, Wiring::single());
    let encoder = InputEncoder::new(&config.input);
    let mut monitor = Monitor::new(config);
    let (mut ticks, mut out, mut frames) = (Ticks::new(TICK_PERIOD_MS, SLEEP_GAP_S), Outputs::default(), Vec::new());
    while let Some(moment) = sim.advance() {
        frames.clear();
        encoder.encode(sim.readings(), &mut frames);
        ticks.advance(moment.time);
        while let Some(time) = ticks.pop(monitor.next_due()) {
            monitor.handle(&Record::tick(time), &mut out);
        }
        for (bus, frame) in &frames {
            monitor.handle(&Record::frame(moment.time, *bus, frame), &mut out);
        }
        each(moment.time, &sim, &monitor, &out.events);
        out.clear();
    }
}
