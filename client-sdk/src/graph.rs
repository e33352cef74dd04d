//! The tasks of a run and their dependencies: a directed acyclic graph by name. Never runs anything.

use std::{collections::HashMap, fmt};

use thiserror::Error;

use crate::task::Task;

/// Tasks and which of them need which others to be done first (thesis figure 5.1).
///
/// Built by chaining; mistakes (double and unknown names, cycles) are reported together with the run.
#[derive(Default)]
pub struct TaskGraph {
    tasks: Vec<(String, Box<dyn Task>)>,
    edges: Vec<(String, String)>,
}

/// A graph that cannot be run; the application is wrong.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum GraphError {
    /// Two tasks of one name.
    #[error("task `{name}` is in the graph twice")]
    DoubleName {
        /// The name.
        name: String,
    },
    /// A dependency names a task that is not in the graph.
    #[error("task `{task}` is to run after `{after}`, but there is no task `{missing}`")]
    UnknownTask {
        /// The dependent task.
        task: String,
        /// What it depends on.
        after: String,
        /// Which of the two is not there.
        missing: String,
    },
    /// Tasks wait for each other.
    #[error("tasks wait for each other: {}", cycle.join(" after "))]
    Cycle {
        /// The names along the cycle, the first one repeated at the end.
        cycle: Vec<String>,
    },
}

/// A task that is ready to be ordered: indices instead of names.
pub(crate) struct GraphNode {
    pub(crate) name: String,
    pub(crate) task: Box<dyn Task>,
    /// Indices of the tasks that wait for this one.
    pub(crate) dependents: Vec<usize>,
    /// How many tasks this one waits for.
    pub(crate) waits_for: usize,
}

impl TaskGraph {
    /// A graph of no task.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a task.
    #[must_use]
    pub fn task(mut self, name: impl Into<String>, task: impl Task) -> Self {
        self.tasks.push((name.into(), Box::new(task)));
        self
    }

    /// Lets `task` start only when `dependency` is finished.
    #[must_use]
    pub fn after(mut self, task: impl Into<String>, dependency: impl Into<String>) -> Self {
        self.edges.push((task.into(), dependency.into()));
        self
    }

    /// Checks the graph and turns names into indices.
    pub(crate) fn check(self) -> Result<Vec<GraphNode>, GraphError> {
        let mut index = HashMap::new();
        let mut nodes: Vec<GraphNode> = Vec::with_capacity(self.tasks.len());
        for (name, task) in self.tasks {
            if index.insert(name.clone(), nodes.len()).is_some() {
                return Err(GraphError::DoubleName { name });
            }
            nodes.push(GraphNode { name, task, dependents: Vec::new(), waits_for: 0 });
        }
        for (task, after) in self.edges {
            let find = |name: &String| {
                index.get(name).copied().ok_or_else(|| GraphError::UnknownTask {
                    task: task.clone(),
                    after: after.clone(),
                    missing: name.clone(),
                })
            };
            let (dependent, dependency) = (find(&task)?, find(&after)?);
            if !nodes[dependency].dependents.contains(&dependent) {
                nodes[dependency].dependents.push(dependent);
                nodes[dependent].waits_for += 1;
            }
        }
        match find_cycle(&nodes) {
            Some(cycle) => Err(GraphError::Cycle { cycle }),
            None => Ok(nodes),
        }
    }
}

/// Removes tasks that wait for nothing until none is left (Kahn 1962); what stays holds a cycle, which is walked.
fn find_cycle(nodes: &[GraphNode]) -> Option<Vec<String>> {
    let mut waits_for: Vec<usize> = nodes.iter().map(|node| node.waits_for).collect();
    let mut ready: Vec<usize> = (0..nodes.len()).filter(|&at| waits_for[at] == 0).collect();
    while let Some(at) = ready.pop() {
        for &dependent in &nodes[at].dependents {
            waits_for[dependent] -= 1;
            if waits_for[dependent] == 0 {
                ready.push(dependent);
            }
        }
    }
    // From any task left, step to one left that it waits for; within as many steps as there are tasks one repeats.
    let mut path = vec![(0..nodes.len()).find(|&at| waits_for[at] > 0)?];
    loop {
        let last = *path.last().expect("the path starts with one task");
        let dependency = (0..nodes.len())
            .find(|&at| waits_for[at] > 0 && nodes[at].dependents.contains(&last))
            .expect("a task left over waits for another one left over");
        let seen = path.iter().position(|&at| at == dependency);
        path.push(dependency);
        if let Some(start) = seen {
            return Some(path[start..].iter().map(|&at| nodes[at].name.clone()).collect());
        }
    }
}

impl fmt::Debug for TaskGraph {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<&String> = self.tasks.iter().map(|(name, _)| name).collect();
        f.debug_struct("TaskGraph").field("tasks", &names).field("edges", &self.edges).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::job::Job;

    struct Nothing;
    impl Task for Nothing {
        fn jobs(&mut self) -> Vec<Box<dyn Job>> {
            Vec::new()
        }
    }

    fn check(graph: TaskGraph) -> Result<Vec<(String, usize, Vec<usize>)>, GraphError> {
        let nodes = graph.check()?;
        Ok(nodes.into_iter().map(|node| (node.name, node.waits_for, node.dependents)).collect())
    }

    #[test]
    fn a_diamond_keeps_its_edges_once() {
        let graph = TaskGraph::new()
            .task("a", Nothing)
            .task("b", Nothing)
            .task("c", Nothing)
            .task("d", Nothing)
            .after("b", "a")
            .after("c", "a")
            .after("d", "b")
            .after("d", "c")
            .after("d", "c");
        let nodes = check(graph).unwrap();
        assert_eq!(nodes[0], ("a".to_owned(), 0, vec![1, 2]));
        assert_eq!(nodes[3], ("d".to_owned(), 2, vec![]));
    }

    #[test]
    fn a_cycle_is_named_without_its_surroundings() {
        let graph = TaskGraph::new()
            .task("before", Nothing)
            .task("x", Nothing)
            .task("y", Nothing)
            .task("z", Nothing)
            .task("behind", Nothing)
            .after("x", "before")
            .after("x", "z")
            .after("y", "x")
            .after("z", "y")
            .after("behind", "z");
        let error = check(graph).unwrap_err();
        let GraphError::Cycle { cycle } = &error else { panic!("expected a cycle, got {error}") };
        assert_eq!(cycle.len(), 4, "{cycle:?}");
        assert_eq!(cycle.first(), cycle.last());
        assert!(!cycle.contains(&"before".to_owned()) && !cycle.contains(&"behind".to_owned()), "{cycle:?}");
        assert!(error.to_string().contains("x after z after y"), "{error}");
    }

    #[test]
    fn a_task_that_waits_for_itself_is_a_cycle() {
        let error = check(TaskGraph::new().task("a", Nothing).after("a", "a")).unwrap_err();
        assert_eq!(error, GraphError::Cycle { cycle: vec!["a".to_owned(), "a".to_owned()] });
    }

    #[test]
    fn double_and_unknown_names_are_errors() {
        let twice = check(TaskGraph::new().task("a", Nothing).task("a", Nothing)).unwrap_err();
        assert_eq!(twice, GraphError::DoubleName { name: "a".to_owned() });
        let unknown = check(TaskGraph::new().task("a", Nothing).after("a", "bvh")).unwrap_err();
        assert_eq!(unknown.to_string(), "task `a` is to run after `bvh`, but there is no task `bvh`");
    }
}
