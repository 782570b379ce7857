//! Operators that rten computes otherwise than ONNX, as `tests/models/oracle.py` finds them.
//!
//! A rule is as narrow as a model allows: a rank or type that the model does not show counts
//! against it.

use super::facts::{BOOLEAN, GraphFacts, OnnxNode};

/// Types whose `Sign` is right.
const INTEGERS: [i64; 6] = [2, 3, 5, 6, 7, BOOLEAN];

/// First version in which `Softmax` and `LogSoftmax` normalise one axis.
const SOFTMAX_OF_ONE_AXIS: i64 = 13;

/// Reason for which rten must not run some models.
pub struct RtenRule {
    /// The operators; none for all of them.
    pub operators: &'static [&'static str],
    /// The attributes, versions and types for which it holds.
    pub when: &'static str,
    /// The result of rten.
    pub computes: &'static str,
    pub kind: RtenRuleKind,
    applies: RuleCondition,
}

type RuleCondition = fn(&OnnxNode<'_>, &GraphFacts<'_>) -> bool;

/// The models or runs that a rule refuses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RtenRuleKind {
    /// Models with such a node.
    Model,
    /// Models with such a node, on processors on which products of 8-bit integers saturate.
    Processor,
    /// Models with such a node and a NaN in their constants, and runs with a NaN in an input.
    Nan,
}

/// A rule that holds for a node of a model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RtenFinding {
    pub kind: RtenRuleKind,
    /// The operator, the reason, and the way out.
    pub message: String,
}

/// A rule that refuses models with a node to which a condition applies.
const fn rule(
    operators: &'static [&'static str],
    when: &'static str,
    computes: &'static str,
    applies: RuleCondition,
) -> RtenRule {
    RtenRule { operators, when, computes, kind: RtenRuleKind::Model, applies }
}

/// A rule that refuses models with one of these operators.
const fn always(operators: &'static [&'static str], computes: &'static str) -> RtenRule {
    rule(operators, "always", computes, |_, _| true)
}

pub const RTEN_RULES: &[RtenRule] = &[
    always(
        &["NonMaxSuppression"],
        "boxes of all classes and images suppress each other, and so do boxes that were \
         themselves suppressed",
    ),
    rule(&["Resize"], "`mode` is `cubic`", "a linear interpolation", |node, _| {
        node.text("mode") == "cubic"
    }),
    rule(
        &["Resize"],
        "`align_corners`, with scales that are not constant whole numbers",
        "with the rounded length in place of the exact one",
        |node, facts| {
            let scales = node.input(2);
            let is_whole = facts.value(scales).is_some_and(|it| it.is_whole);
            node.text("coordinate_transformation_mode") == "align_corners"
                && !scales.is_empty()
                && !is_whole
        },
    ),
    rule(
        &["Softmax", "LogSoftmax"],
        "the opset is below 13, and `axis` is not known to be the last",
        "a distribution along `axis` in place of one over all axes from it on",
        normalises_more_than_one_axis,
    ),
    always(&["ArgMax", "ArgMin"], "the last of equal values in place of the first"),
    rule(
        &["Conv", "ConvInteger", "ConvTranspose", "MaxPool", "AveragePool"],
        "`auto_pad` is `SAME_LOWER`, unless strides are 1 and kernels odd",
        "the padding of `SAME_UPPER`",
        |node, _| {
            let kernel = node.numbers("kernel_shape");
            let is_even = node.numbers("strides").iter().all(|stride| *stride == 1)
                && !kernel.is_empty()
                && kernel.iter().all(|length| length % 2 == 1);
            node.text("auto_pad") == "SAME_LOWER" && !is_even
        },
    ),
    always(
        &["DynamicQuantizeLinear"],
        "a scale that is off by one unit in the last place, and with it other steps",
    ),
    rule(
        &["QuantizeLinear"],
        "the scale is not constant",
        "another step for values between two, as the scale is off in the last place",
        |node, facts| !facts.value(node.input(1)).is_some_and(|it| it.is_constant),
    ),
    always(&["Softplus"], "infinity for numbers above 88"),
    rule(
        &["SequenceInsert"],
        "with a position",
        "the place behind that of a negative position",
        |node, _| !node.input(2).is_empty(),
    ),
    always(&["ConvInteger"], "a padding of 0 in place of the zero point"),
    RtenRule {
        operators: &["MatMulInteger"],
        when: "on x86-64 processors without VNNI",
        computes: "sums of two products that saturate in 16 bits",
        kind: RtenRuleKind::Processor,
        applies: |_, _| true,
    },
    rule(
        &["MatMul", "MatMulInteger"],
        "the second input has one dimension, and the first is not known to have at most two",
        "a result with a dimension too many",
        |node, facts| {
            let ranks = [0, 1].map(|input| facts.rank(node.input(input)));
            ranks[1] == Some(1) && ranks[0].is_none_or(|rank| rank > 2)
        },
    ),
    rule(&["Sign"], "the input is not known to have integers", "1 for 0", |node, facts| {
        !facts.element(node.input(0)).is_some_and(|it| INTEGERS.contains(&it))
    }),
    rule(
        &["Cast"],
        "to boolean, from an input that is not known to be boolean",
        "false for fractions, and numbers other than 0 and 1",
        |node, facts| {
            node.number("to") == Some(BOOLEAN) && facts.element(node.input(0)) != Some(BOOLEAN)
        },
    ),
    rule(
        &["CastLike"],
        "the second input is boolean, or of an unknown type",
        "false for fractions, and numbers other than 0 and 1",
        |node, facts| facts.element(node.input(1)).is_none_or(|it| it == BOOLEAN),
    ),
    rule(
        &[],
        "a constant exceeds 32 bits, but for the bounds of `Slice`",
        "the largest number of 32 bits in its place",
        |node, facts| {
            let is_wide = |name: &&str| facts.value(name).is_some_and(|it| it.is_wide);
            node.operator != "Slice" && node.inputs.iter().any(is_wide)
        },
    ),
    RtenRule {
        operators: &["Relu", "Clip"],
        when: "a constant or an input of a run has a NaN",
        computes: "0 or a bound for NaN, which hides it",
        kind: RtenRuleKind::Nan,
        applies: |_, _| true,
    },
];

/// Returns whether a softmax of an old version has values beside those along its axis.
fn normalises_more_than_one_axis(node: &OnnxNode<'_>, facts: &GraphFacts<'_>) -> bool {
    if facts.opset >= SOFTMAX_OF_ONE_AXIS {
        return false;
    }
    let axis = node.number("axis");
    // rten takes the last without one, and ONNX the second.
    let axis_of_rten = axis.unwrap_or(-1);
    let axis = axis.unwrap_or(1);
    let names = [node.input(0), node.output()];
    let shape = names.iter().find_map(|name| facts.value(name)?.shape.clone());
    let rank = names.iter().find_map(|name| facts.rank(name));
    let Some(rank) = rank.and_then(|rank| i64::try_from(rank).ok()) else { return axis != -1 };
    let from_front = |axis: i64| if axis < 0 { axis + rank } else { axis };
    if from_front(axis) != from_front(axis_of_rten) {
        return true;
    }
    let behind = usize::try_from(from_front(axis) + 1).unwrap_or(usize::MAX);
    let all_one = |shape: &Vec<i64>| shape.iter().skip(behind).all(|length| *length == 1);
    from_front(axis) != rank - 1 && !shape.is_some_and(|shape| all_one(&shape))
}

/// Returns the rules that hold for a model, each with the first operator that it was found for.
pub(super) fn findings(facts: &GraphFacts<'_>, has_functions: bool) -> Vec<RtenFinding> {
    let mut found = Vec::new();
    if has_functions {
        let message = format!("it has functions of its own, which rten ignores; {WAY_OUT}");
        found.push(RtenFinding { kind: RtenRuleKind::Model, message });
    }
    for rule in RTEN_RULES {
        let concerns = |node: &&OnnxNode<'_>| {
            (rule.operators.is_empty() || rule.operators.contains(&node.operator))
                && (rule.applies)(node, facts)
        };
        let Some(node) = facts.nodes.iter().find(concerns) else { continue };
        let has_nan = rule.kind == RtenRuleKind::Nan && facts.has_nan;
        let kind = if has_nan { RtenRuleKind::Model } else { rule.kind };
        let (operator, opset, when, computes) =
            (node.operator, facts.opset, rule.when, rule.computes);
        let message = format!(
            "it has operator `{operator}` of opset {opset}, for which rten computes {computes} \
             ({when}); {WAY_OUT}"
        );
        found.push(RtenFinding { kind, message });
    }
    found
}

/// The advice for a model that rten must not run.
const WAY_OUT: &str = "name `onnxruntime` in `providers` (`pip install onnxruntime` \
                                  brings its library: docs/models.md), or export the model \
                                  without it";
