use gleaner_base::visible;
use gleaner_protocol::{Holds, Layer};

/// The layers of isolation in a line: those that hold by name, the others with the reason.
pub(crate) fn isolation(layers: &[Layer]) -> String {
    let named = |holds| layers.iter().filter(move |layer| layer.holds == holds);
    let mut parts = vec![format!(
        "{} hold",
        named(Holds::Yes).map(|layer| visible(&layer.name)).collect::<Vec<_>>().join(", ")
    )];
    for (holds, word) in [(Holds::Partly, "in part"), (Holds::No, "not here")] {
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
    fn what_holds_is_named_and_what_does_not_has_its_reason() {
        let layers = [
            Layer::yes("files", "a"),
            Layer::yes("sockets", "b"),
            Layer::no("control group", "none was delegated"),
        ];
        assert_eq!(
            isolation(&layers),
            "isolation: files, sockets hold; not here: control group (none was delegated)\n"
        );
    }
}
