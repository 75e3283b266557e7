//! Describes faults of JSON documents for users.

/// Returns what is wrong with a JSON document, and where. A document that ends early is described in plain words.
pub fn json_fault(error: &serde_json::Error) -> String {
    if error.is_eof() {
        return format!("the document ends early, at line {} column {}", error.line(), error.column());
    }
    error.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn truncated_document_is_said_to_end_early() {
        let fault = |text: &str| json_fault(&serde_json::from_str::<Vec<u8>>(text).expect_err("faulty"));
        assert_eq!(fault("[1, "), "the document ends early, at line 1 column 4");
        assert!(fault("[x]").starts_with("expected value"), "{}", fault("[x]"));
    }
}
