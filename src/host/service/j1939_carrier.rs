//! Who carries J1939: always this program itself, frame by frame, so that replay gives the same frames. Whether the
//! kernel has a stack of its own is told at the start, for whoever looks for the node there.

/// Where the kernel lists the protocols it has.
const PROTOCOLS: &str = "/proc/net/protocols";
/// The kernel's J1939 stack in that list.
const KERNEL_STACK: &str = "CAN_J1939";

/// Says it in one line. A kernel that loads its stack on first use does not list it before.
pub(super) fn tell() {
    let kernel_stack = in_words(std::fs::read_to_string(PROTOCOLS).ok().as_deref());
    tracing::info!(kernel_stack, "J1939 carried by packwatch itself over raw CAN");
}

/// From the list; `None` = it could not be read.
fn in_words(protocols: Option<&str>) -> &'static str {
    let is_listed = |list: &str| list.lines().any(|line| line.split_whitespace().next() == Some(KERNEL_STACK));
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
    fn the_kernels_stack_is_told_from_its_list_of_protocols() {
        let list = "protocol  size sockets  memory press maxhdr  slab module     cl co\nPACKET    1600      0      -1   NI       0   no   kernel      y  n\n";
        assert_eq!(in_words(Some(list)), "not loaded");
        let with_stack = format!("{list}CAN_J1939  896      1      -1   NI       0   no   can_j1939   n  n\n");
        assert_eq!(in_words(Some(&with_stack)), "loaded");
        assert_eq!(in_words(Some("PACKET 1 can_j1939\n")), "not loaded", "only a protocol of that name");
        assert_eq!(in_words(None), "unknown");
    }
}
