//! Adds the estimates of a replay to the output.

use std::cell::RefCell;
use std::io;
use std::rc::Rc;

use packwatch_host::failure::Failure;

use super::Args;
use super::output::Output;
use crate::cli::common::output::failure;
use crate::cli::common::replaying::replay;
use crate::config::Config;
use crate::monitor::Outputs;
use crate::replay::Sinks;

/// The output that the replay writes to, and the first error.
struct Target {
    output: Output,
    fault: Option<io::Error>,
}

impl Target {
    fn handle(&mut self, outputs: &Outputs) {
        let Output::Mcap(file) = &mut self.output else { return };
        for estimate in &outputs.estimates {
            if let Err(error) = file.write_estimate(estimate) {
                self.fault.get_or_insert(error);
            }
        }
    }
}

pub(super) fn write(args: &Args, config: Config, output: Output) -> Result<Output, Failure> {
    let target = Rc::new(RefCell::new(Target { output, fault: None }));
    let shared = Rc::clone(&target);
    let sink = move |outputs: &Outputs| shared.borrow_mut().handle(outputs);
    let sinks = Sinks { outputs: Some(Box::new(sink)), ..Sinks::default() };
    replay(&args.logs, &args.input, &config, sinks)?;
    let target = Rc::into_inner(target).map(RefCell::into_inner);
    match target {
        Some(Target { output, fault: None }) => Ok(output),
        Some(Target { fault: Some(error), .. }) => Err(failure(error)),
        None => Err(Failure::new("the replay still writes estimates")),
    }
}
