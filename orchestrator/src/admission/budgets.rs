//! The most that all lambdas together may ask for.

use std::collections::BTreeMap;
use std::thread::available_parallelism;

use gleaner_base::{ByteSize, Exit, Failure};
use gleaner_lambda::Vehicle;
use gleaner_lambda::manifest::ItemName;
use gleaner_protocol::vehicle_api::{Capacity, ResourceDemand};

use super::demand::LambdaDemand;
use super::measured::CurrentUse;

/// Difference of sums of fractions that is none.
const ROUNDING: f64 = 1e-9;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Resource {
    Memory,
    Topics,
    Cpu,
    ModelTime,
}

impl Resource {
    fn name(self) -> &'static str {
        match self {
            Self::Memory => "memory",
            Self::Topics => "topics",
            Self::Cpu => "cpu",
            Self::ModelTime => "model_time",
        }
    }

    fn unit(self) -> &'static str {
        match self {
            Self::Memory | Self::Topics => "B",
            Self::Cpu => "cores",
            Self::ModelTime => "s/s",
        }
    }

    fn show(self, amount: f64) -> String {
        match self {
            Self::Memory | Self::Topics => ByteSize::new(amount as u64).to_string(),
            Self::Cpu => format!("{amount:.2} cores"),
            Self::ModelTime => format!("{amount:.2} s/s"),
        }
    }

    /// Returns what is missing for a deployment.
    fn missing(self) -> &'static str {
        match self {
            Self::Memory => "memory for deployment",
            Self::Topics => "shared memory for the topics of deployment",
            Self::Cpu => "CPU time for deployment",
            Self::ModelTime => "model time for deployment",
        }
    }

    fn help(self) -> &'static str {
        match self {
            Self::Memory => {
                "lower `memory` in the lambda's [limits], stop another deployment, or raise \
                 `deployments.memory` in vehicle.toml"
            }
            Self::Topics => {
                "lower `depth`, `hold` or `max_size` of its inputs, stop another deployment, or \
                 raise `deployments.topics` in vehicle.toml"
            }
            Self::Cpu => {
                "state what it needs in the lambda's [demand], if that is less; stop another \
                 deployment; or raise `deployments.cpu` in vehicle.toml"
            }
            Self::ModelTime => {
                "state `model_time` in the lambda's [demand], if that is less; use a smaller \
                 model; stop another deployment; or raise `deployments.model_time` in vehicle.toml"
            }
        }
    }

    /// Returns what these lambdas ask for together. They share the memory of a topic.
    fn sum<'a>(self, demands: impl Iterator<Item = &'a LambdaDemand>) -> f64 {
        let sum: f64 = match self {
            Self::Memory => demands.map(|demand| demand.memory.amount).sum(),
            Self::Cpu => demands.map(|demand| demand.cpu.amount).sum(),
            Self::ModelTime => demands.map(|demand| demand.model_time.amount).sum(),
            Self::Topics => {
                let mut topics = BTreeMap::new();
                for (topic, bytes) in demands.flat_map(|demand| &demand.topics) {
                    let largest = topics.entry(topic).or_insert(*bytes);
                    *largest = *bytes.max(largest);
                }
                topics.into_values().map(|bytes| bytes as f64).sum()
            }
        };
        // A sum of no fractions is -0.
        sum + 0.0
    }

    /// Returns the demand of one lambda, for the status.
    fn of(self, demand: &LambdaDemand) -> ResourceDemand {
        let asked = match self {
            Self::Memory => Some(&demand.memory),
            Self::Cpu => Some(&demand.cpu),
            Self::ModelTime => Some(&demand.model_time),
            Self::Topics => None,
        };
        ResourceDemand {
            resource: self.name().to_owned(),
            unit: self.unit().to_owned(),
            asked: self.sum(std::iter::once(demand)),
            peak: asked.and_then(|asked| asked.peak),
            source: asked.map_or_else(|| "of its inputs".to_owned(), |asked| asked.source()),
            exceeds: asked.is_some_and(|asked| asked.exceeds),
        }
    }
}

/// The most of a resource that may be asked for.
#[derive(Debug)]
struct ResourceBudget {
    resource: Resource,
    most: f64,
    source: String,
}

#[derive(Debug)]
pub(crate) struct Budgets([ResourceBudget; 4]);

impl Budgets {
    /// Returns the budgets of the configuration, on this machine.
    pub(crate) fn of(vehicle: &Vehicle) -> Self {
        let cores = available_parallelism().map_or(1, usize::from);
        let system = rustix::system::sysinfo();
        let memory = u64::from(system.mem_unit).saturating_mul(system.totalram);
        Self::on(vehicle, memory, cores)
    }

    pub(super) fn on(vehicle: &Vehicle, memory: u64, cores: usize) -> Self {
        let settings = &vehicle.deployments;
        let size =
            |resource, chosen: Option<ByteSize>, key: &str, part: u64, text: &str| ResourceBudget {
                resource,
                most: chosen.map_or(memory / part, ByteSize::bytes) as f64,
                source: match chosen {
                    Some(_) => format!("`deployments.{key}` in vehicle.toml"),
                    None => format!("{text} of the machine's memory"),
                },
            };
        let percent = |share: f64| (share * 100.0).round();
        let of_cores = if cores == 1 { "core".to_owned() } else { format!("{cores} cores") };
        Self([
            size(Resource::Memory, settings.memory, "memory", 2, "50 %"),
            size(Resource::Topics, settings.topics, "topics", 4, "25 %"),
            ResourceBudget {
                resource: Resource::Cpu,
                most: settings.cpu * cores as f64,
                source: format!("{} % of the machine's {of_cores}", percent(settings.cpu)),
            },
            ResourceBudget {
                resource: Resource::ModelTime,
                most: settings.model_time,
                source: format!("{} % of the time", percent(settings.model_time)),
            },
        ])
    }

    /// Admits a deployment that asks for `asked`, beside those that run. One that asks for no more
    /// than the deployment that it replaces is admitted, whatever the others ask for. A failure
    /// names the resource and all numbers.
    pub(crate) fn admit(
        &self,
        id: &ItemName,
        asked: &LambdaDemand,
        wanted: &BTreeMap<ItemName, LambdaDemand>,
    ) -> Result<(), Failure> {
        for ResourceBudget { resource, most, source } in &self.0 {
            let others = || wanted.iter().filter(|(it, _)| *it != id).map(|(_, demand)| demand);
            let sum = resource.sum(others().chain([asked]));
            let before = wanted.get(id).map(|_| resource.sum(wanted.values()));
            if sum <= most.max(before.unwrap_or(0.0)) + ROUNDING {
                continue;
            }
            let others = resource.sum(others());
            let [more, others, most] = [sum - others, others, *most].map(|it| resource.show(it));
            let origin = resource.of(asked).source;
            let message = format!("there is no {} `{id}`", resource.missing());
            let mut failure = Failure::new(Exit::Denied, message);
            failure.causes = vec![
                format!(
                    "it asks for {more}, the other deployments for {others}, and all may ask for \
                     {most} ({source})"
                ),
                format!("its demand is {origin}"),
            ];
            return Err(failure.with_help(resource.help()));
        }
        Ok(())
    }

    /// Returns the capacity of each resource, with what the wanted lambdas ask for and use.
    pub(crate) fn capacity(
        &self,
        wanted: &BTreeMap<ItemName, LambdaDemand>,
        used: &CurrentUse,
    ) -> Vec<Capacity> {
        let of = |ResourceBudget { resource, most, source }: &ResourceBudget| Capacity {
            resource: resource.name().to_owned(),
            unit: resource.unit().to_owned(),
            asked: resource.sum(wanted.values()),
            used: match resource {
                Resource::Memory => used.memory,
                Resource::Topics => None,
                Resource::Cpu => used.cpu,
                Resource::ModelTime => used.model_time,
            },
            most: *most,
            source: source.clone(),
        };
        self.0.iter().map(of).collect()
    }

    pub(crate) fn demand(&self, demand: &LambdaDemand) -> Vec<ResourceDemand> {
        self.0.iter().map(|budget| budget.resource.of(demand)).collect()
    }
}
