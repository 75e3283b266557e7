//! Logs which J1939 stack is in use. packwatch runs its own stack on raw CAN, because a replay then produces the same
//! frames. The log line also states whether the kernel's stack is loaded, for users who look for packwatch's node
//! there.

/// Logs one line. If the kernel loads its J1939 stack only at the first use, the line says "not loaded" until then.
pub(super) fn log_kernel_stack() {
    let kernel_stack = stack_state(std::fs::read_to_string("/proc/net/protocols").ok().as_deref());
    tracing::info!(kernel_stack, "J1939 runs in packwatch over raw CAN, not in the kernel");
}

/// The stack's state according to the kernel's list of protocols; `None` = the list could not be read.
fn stack_state(protocols: Option<&str>) -> &'static str {
    let is_listed = |list: &str| list.lines().any(|line| line.split_whitespace().next() == Some("CAN_J1939"));
    match protocols.map(is_listed) {
        Some(true) => "loaded",
        Some(false) => "not loaded",
        None => "unknown",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernel_stack_is_found_in_protocol_list() {
        let list = "protocol  size sockets  memory press maxhdr  slab module     cl co\nPACKET    1600      0      -1   NI       0   no   kernel      y  n\n";
        assert_eq!(stack_state(Some(list)), "not loaded");
        let with_stack = format!("{list}CAN_J1939  896      1      -1   NI       0   no   can_j1939   n  n\n");
        assert_eq!(stack_state(Some(&with_stack)), "loaded");
        assert_eq!(stack_state(Some("PACKET 1 can_j1939\n")), "not loaded", "a module name alone does not count");
        assert_eq!(stack_state(None), "unknown");
    }
}
