//! Parses `[demand]`: the resources that a lambda needs, as its author states.

use super::bounds;
use super::error::ManifestError;
use super::value::TomlValue;
use super::{Demand, LambdaKind, LambdaSection, Limits, ModelSpec, ScheduleSpec};

/// Parses the table. Each key must have a meaning for a lambda of this kind.
pub(super) fn demand(
    value: &TomlValue,
    lambda: &LambdaSection,
    schedule: &ScheduleSpec,
    models: &[ModelSpec],
) -> Result<Demand, ManifestError> {
    let table = value.table("[demand]", &["rate_hz", "cpu", "fuel", "model_time"])?;
    let misplaced = [
        (
            "rate_hz",
            matches!(schedule, ScheduleSpec::Periodic { .. }),
            "has no meaning with `period`",
            "remove it: the period states the rate",
        ),
        (
            "fuel",
            lambda.kind == LambdaKind::Python,
            "has no meaning with kind = \"python\"",
            "state `cpu`, the CPU time of a wake: Python has no fuel",
        ),
        (
            "fuel",
            table.get("cpu").is_some(),
            "conflicts with `cpu`",
            "keep `cpu` or `fuel`: a vehicle converts fuel to CPU time",
        ),
        (
            "model_time",
            models.is_empty(),
            "has no meaning without a [[model]]",
            "remove it, or add the model",
        ),
    ];
    for (key, is_misplaced, why, help) in misplaced {
        if let Some(value) = table.get(key).filter(|_| is_misplaced) {
            return Err(value.misplaced(why, help));
        }
    }
    let duration = |key| table.get(key).map(|it| it.duration(&bounds::DEMAND_TIME)).transpose();
    let fuel = Limits::MIN.fuel..=Limits::MAX.fuel;
    Ok(Demand {
        rate_hz: table.get("rate_hz").map(|it| it.number(&bounds::RATE_HZ)).transpose()?,
        cpu: duration("cpu")?,
        fuel: table.get("fuel").map(|it| it.integer(&fuel)).transpose()?,
        model_time: duration("model_time")?,
    })
}
