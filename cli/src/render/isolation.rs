//! Formats the isolation layers of a lambda.

use gleaner_base::visible;
use gleaner_protocol::{Holds, Layer};

/// Formats the isolation layers in one line: active ones by name, the others with the reason.
pub(crate) fn isolation(layers: &[Layer]) -> String {
    let named = |holds| layers.iter().filter(move |layer| layer.holds == holds);
    let mut parts = vec![format!(
        "{} active",
        named(Holds::Yes).map(|layer| visible(&layer.name)).collect::<Vec<_>>().join(", ")
    )];
    for (holds, word) in [(Holds::Partly, "partial"), (Holds::No, "missing")] {
        let those: Vec<_> = named(holds)
            .map(|layer| format!("{} ({})", visible(&layer.name), visible(&layer.note)))
            .collect();
        if !those.is_empty() {
            parts.push(format!("{word}: {}", those.join(", ")));
        }
    }
    format!("isolation: {}\n", parts.join("; "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn active_layers_are_named_and_missing_ones_have_a_reason() {
        let layers = [
            Layer::yes("files", "a"),
            Layer::yes("sockets", "b"),
            Layer::no("control group", "not delegated"),
        ];
        assert_eq!(
            isolation(&layers),
            "isolation: files, sockets active; missing: control group (not delegated)\n"
        );
    }
}
