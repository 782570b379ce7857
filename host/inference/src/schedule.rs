//! The runs in progress, and the next one.
//!
//! Lambdas within their demand run one at a time. A run beyond it runs beside these, one at a time
//! as well: a backend may be unable to interrupt a run, so it must not hold up others. A run that
//! uses up its lambda's time while it lasts becomes such a run, and so are the next ones of that
//! lambda for a while, so that it cannot hold up others by it again and again. After an end of the
//! process that several models may have caused, everything runs apart, so that the next end has one
//! cause.

use std::collections::HashMap;
use std::sync::Arc;

use gleaner_protocol::inference::MODEL_WORKERS;

use crate::backend::StopSignal;
use crate::client::LambdaId;
use crate::places::PlacedInput;
use crate::queue::FairQueue;
use crate::sessions::SessionId;

/// A run may take this multiple of its lambda's stated time, as others run beside it.
const TOLERANCE: u64 = 2;
/// Time of a run of a lambda that states none, in ns.
const UNSTATED_NS: u64 = 200_000_000;
/// A lambda is beyond its demand for this multiple of the time of a run that was.
const BEYOND: u64 = 10;

#[derive(Debug, Default)]
pub(crate) struct RunSchedule {
    /// By the identity of the lambda: a restart or another revision does not change when it is
    /// within its demand again.
    allowances: HashMap<String, RunAllowance>,
    queue: FairQueue<LambdaId, WaitingRun>,
    running: Vec<RunInProgress>,
    last_job: u64,
}

#[derive(Debug, Default)]
struct RunAllowance {
    run_ns: u64,
    beyond_until_ns: u64,
}

/// A run that waits for others.
#[derive(Debug)]
pub(crate) struct WaitingRun {
    /// Identity of the lambda.
    pub(crate) account: String,
    pub(crate) session: SessionId,
    pub(crate) inputs: Vec<PlacedInput>,
}

#[derive(Debug)]
pub(crate) struct RunInProgress {
    pub(crate) job: u64,
    pub(crate) lambda: LambdaId,
    pub(crate) stop: Arc<StopSignal>,
    account: String,
    session: SessionId,
    /// Time at which it uses up its lambda's time, in ns.
    paid_until_ns: u64,
}

impl RunSchedule {
    /// Sets the time that a lambda has stated for its models in a wake, in ns.
    pub(crate) fn allow(&mut self, account: &str, demand: Option<u64>) {
        let run_ns = demand.map_or(UNSTATED_NS, |stated| stated.saturating_mul(TOLERANCE));
        self.allowances.entry(account.to_owned()).or_default().run_ns = run_ns;
    }

    pub(crate) fn push(&mut self, lambda: LambdaId, deadline: Option<u64>, run: WaitingRun) {
        self.queue.push(lambda, deadline, run);
    }

    /// Removes the waiting run of a lambda.
    pub(crate) fn remove(&mut self, lambda: LambdaId) {
        self.queue.remove(lambda);
    }

    pub(crate) fn is_idle(&self) -> bool {
        self.running.is_empty()
    }

    /// Requests the end of a run, or of all of them.
    pub(crate) fn stop(&self, job: Option<u64>) {
        for run in self.running.iter().filter(|run| job.is_none_or(|job| run.job == job)) {
            run.stop.stop();
        }
    }

    /// Begins the next run, and returns it with its inputs. With `is_apart`, none begins beside
    /// another one.
    pub(crate) fn begin(
        &mut self,
        is_apart: bool,
        now_ns: u64,
    ) -> Option<(&RunInProgress, Vec<PlacedInput>)> {
        let Self { allowances, queue, running, last_job } = self;
        if running.len() >= MODEL_WORKERS || is_apart && !running.is_empty() {
            return None;
        }
        let left_ns = |run: &WaitingRun| {
            let allowance = allowances.get(&run.account);
            allowance.filter(|it| it.beyond_until_ns <= now_ns).map_or(0, |it| it.run_ns)
        };
        let is_free = |next: &WaitingRun| {
            let differs =
                |run: &RunInProgress| run.session != next.session && run.account != next.account;
            running.iter().all(differs)
        };
        let paid = running.iter().filter(|run| run.paid_until_ns > now_ns).count();
        let mut popped = None;
        if paid == 0 {
            popped = queue.pop(|next| is_free(next) && left_ns(next) > 0);
        }
        if popped.is_none() && paid == running.len() && !is_apart {
            popped = queue.pop(|next| is_free(next) && left_ns(next) == 0);
        }
        let (lambda, next) = popped?;
        *last_job += 1;
        let (job, paid_until_ns) = (*last_job, now_ns.saturating_add(left_ns(&next)));
        let WaitingRun { account, session, inputs } = next;
        let stop = Arc::new(StopSignal::default());
        running.push(RunInProgress { job, lambda, stop, account, session, paid_until_ns });
        running.last().map(|run| (run, inputs))
    }

    /// Returns the time at which a waiting run may begin although none ends, in ns.
    pub(crate) fn changes_at(&self, now_ns: u64) -> Option<u64> {
        let until = self.running.iter().map(|run| run.paid_until_ns).filter(|at| *at > now_ns);
        until.min().filter(|_| !self.queue.is_empty())
    }

    /// Ends a run, which took this time.
    pub(crate) fn finish(&mut self, job: u64, ran_ns: u64, now_ns: u64) -> Option<RunInProgress> {
        let index = self.running.iter().position(|run| run.job == job)?;
        let run = self.running.remove(index);
        if let Some(allowance) = self.allowances.get_mut(&run.account)
            && ran_ns > allowance.run_ns
        {
            allowance.beyond_until_ns = now_ns.saturating_add(ran_ns.saturating_mul(BEYOND));
        }
        Some(run)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sessions::{SessionKey, SessionTable};

    const MS: u64 = 1_000_000;
    const VICTIM: LambdaId = LambdaId(0);

    /// Returns the schedule of a victim that states nothing and five hostile lambdas that state
    /// 1 ms; and a function that adds a run of one of them.
    fn schedule() -> (RunSchedule, impl Fn(&mut RunSchedule, LambdaId, u64)) {
        let (mut table, mut schedule) = (SessionTable::default(), RunSchedule::default());
        let sessions = [(); 6].map(|()| table.add(SessionKey::default(), String::new()));
        schedule.allow("0", None);
        (1..6).for_each(|id| schedule.allow(&id.to_string(), Some(MS)));
        let push = move |schedule: &mut RunSchedule, lambda: LambdaId, deadline| {
            let (account, session) = (lambda.0.to_string(), sessions[lambda.0 as usize]);
            schedule.push(lambda, Some(deadline), WaitingRun { account, session, inputs: vec![] });
        };
        (schedule, push)
    }

    fn begin(schedule: &mut RunSchedule, is_apart: bool, at: u64) -> Option<(u64, u64)> {
        schedule.begin(is_apart, at).map(|(next, _)| (next.lambda.0, next.job))
    }

    #[test]
    fn lambdas_beyond_their_demand_run_beside_the_others_and_delay_none() {
        let (mut runs, push) = schedule();
        (1..6).for_each(|id| push(&mut runs, LambdaId(id), id));
        push(&mut runs, VICTIM, 400 * MS);
        // Each holds up the others for its 2 ms.
        for id in 1..6 {
            let at = (id - 1) * 2 * MS;
            assert_eq!(begin(&mut runs, false, at), Some((id, id)));
            assert_eq!(begin(&mut runs, false, at + MS), None);
            assert_eq!(runs.changes_at(at + MS), Some(at + 2 * MS));
        }
        assert_eq!(begin(&mut runs, false, 10 * MS), Some((0, 6)));
        assert_eq!(runs.changes_at(10 * MS), None, "none waits");
        runs.finish(6, 20 * MS, 30 * MS);
        (1..6).for_each(|job| drop(runs.finish(job, 2000 * MS, 2000 * MS)));
        // The next ones begin beside those within their demand, one at a time, and before none.
        (1..3).for_each(|id| push(&mut runs, LambdaId(id), id));
        push(&mut runs, VICTIM, 2400 * MS);
        for started in [Some((0, 7)), Some((1, 8)), None] {
            assert_eq!(begin(&mut runs, false, 2000 * MS), started);
        }
        runs.finish(7, 20 * MS, 2020 * MS);
        // A short run in between does not make a lambda hold up others again.
        runs.finish(8, MS, 2020 * MS);
        push(&mut runs, LambdaId(1), 3);
        push(&mut runs, VICTIM, 2600 * MS);
        for started in [Some((0, 9)), Some((2, 10)), None] {
            assert_eq!(begin(&mut runs, false, 2020 * MS), started);
        }
    }

    #[test]
    fn apart_one_runs_at_a_time_and_a_lambda_beyond_its_demand_waits() {
        let (mut runs, push) = schedule();
        push(&mut runs, LambdaId(1), 1);
        push(&mut runs, VICTIM, 2);
        assert_eq!(begin(&mut runs, true, 0), Some((1, 1)));
        assert_eq!(begin(&mut runs, true, 1000 * MS), None);
        runs.finish(1, 2000 * MS, 2000 * MS);
        push(&mut runs, LambdaId(1), 3);
        assert_eq!(begin(&mut runs, true, 2000 * MS), Some((0, 2)));
        runs.finish(2, 20 * MS, 2020 * MS);
        // A restart changes nothing.
        runs.allow("1", Some(MS));
        assert_eq!(begin(&mut runs, true, 21_999 * MS), None);
        assert_eq!(begin(&mut runs, true, 22_000 * MS), Some((1, 3)));
    }
}
